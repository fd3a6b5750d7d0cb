// plotly.js and the figures travel compressed; they are unpacked here, in the browser.
const unpack = async script => {
  const bytes = Uint8Array.from(atob(script.textContent), letter => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).text();
};
const plots = document.querySelectorAll(".figure > div");
const figures = new Map();
const load = async () => {
  const script = document.createElement("script");
  script.textContent = await unpack(document.getElementById("plotly"));
  document.head.append(script);
  await Promise.all([...plots].map(async plot => figures.set(plot, await unpack(plot.nextElementSibling))));
};

const config = {
  responsive: true, displaylogo: false, scrollZoom: false,
  showSendToCloud: false,  // plotly.js offers an upload of the figure to its maker's server
  modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d", "resetCameraLastSave3d"],
};
const draw = plot => {
  if (plot.dataset.drawn) return;
  plot.dataset.drawn = "yes";
  const figure = JSON.parse(figures.get(plot));
  Plotly.newPlot(plot, figure.data, figure.layout, config);
};
const clear = plot => {
  if (!plot.dataset.drawn || plot.dataset.space !== "yes") return;
  delete plot.dataset.drawn;
  Plotly.purge(plot);
};

// Figures are drawn when they come near the window: a page of many controllers opens at once. Browsers keep only about
// a dozen WebGL contexts, so figures in space are given back when they are far away again.
load().then(() => {
  const watcher = new IntersectionObserver(
    seen => seen.forEach(entry => (entry.isIntersecting ? draw : clear)(entry.target)), {rootMargin: "800px"});
  plots.forEach(plot => watcher.observe(plot));
  addEventListener("beforeprint", () => plots.forEach(draw));
});
