"""`flytune completion`: what a shell offers when TAB is pressed.

Bash asks flytune for everything, since the script that cyclopts writes for bash knows neither the second value of an
option nor `vehicle=NAME`. The scripts for zsh and fish are those of cyclopts, and ask for names alone.
"""

import os
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from cyclopts import App, Parameter

if TYPE_CHECKING:
    from cyclopts.completion import CompletionContext

# the words go to flytune as cyclopts expects them; bash splits words at = @ and : as well, so they are joined first
BASH = r"""
_flytune() {
  local typed="" fragment="${COMP_WORDS[COMP_CWORD]}" word="" glued="" i value prefix="" begun="" files=""
  for ((i = 1; i <= COMP_CWORD; i++)); do
    if [[ -n "$glued" || ( -n "$word" && "${COMP_WORDS[i]}" =~ ^[=@:]+$ ) ]]; then
      word+="${COMP_WORDS[i]}"
    else
      ((i > 1)) && typed+="$word"$'\x1f'
      word="${COMP_WORDS[i]}"
    fi
    [[ "${COMP_WORDS[i]}" =~ ^[=@:]+$ ]] && glued=yes || glued=""
  done
  [[ -n "$glued" ]] && fragment=""
  local known=$((${#word} - ${#fragment})) program="${COMP_WORDS[0]}"
  type -P "$program" > /dev/null || program=flytune
  COMPREPLY=()
  while IFS= read -r value; do
    case "$value" in
      $'\x1f'begin) begun=yes ;;
      $'\x1f'files) files=yes ;;
      $'\x1f'prefix*) prefix="${value#*$'\t'}" ;;
      $'\x1f'* | "") ;;
      *)
        value="$prefix${value%%$'\t'*}"
        [[ -n "$begun" && "$value" == "$word"* ]] && COMPREPLY+=("${value:known}")
        ;;
    esac
  done < <(CYCLOPTS_COMPLETION_WORDS="$typed$word"$'\x1f' "$program" __complete 2> /dev/null)
  if [[ -n "$files" ]]; then
    compopt -o filenames 2> /dev/null
    while IFS= read -r value; do COMPREPLY+=("$value"); done < <(compgen -f -- "$fragment")
  elif [[ "${COMPREPLY[*]: -1}" == *[=/] ]]; then
    compopt -o nospace 2> /dev/null
  fi
}
complete -o default -F _flytune flytune
"""
CLASSICAL = ("pid", "geometric", "lqr")
MODELS, TASK_FILES, VEHICLE_FILES = (".safetensors", ".onnx", ".zip"), (".toml",), (".toml", ".urdf", ".sdf", ".xml")


def script(app: App, shell: Any) -> str:
    """The completion script of a shell."""
    return BASH.strip() if shell == "bash" else app.generate_completion(prog_name="flytune", shell=shell)


def completed_by(completer: "Callable[[CompletionContext], Any]") -> Parameter:
    """The part of an option that says what may stand there."""
    return Parameter(completer=completer)


def tasks(context: "CompletionContext") -> list[str]:
    """Presets, run directories and TOML files."""
    from flytune.config.recognise import TASK, shipped

    return [*shipped(TASK), *_paths(context.incomplete, TASK_FILES)]


def controllers(context: "CompletionContext") -> list[str]:
    """Controllers and policies that ship, run directories and policy files."""
    from flytune.config.recognise import CONTROLLER, shipped

    name, at, _ = context.incomplete.partition("@")
    gains = [f"{name}@{each}" for each in ("textbook", "tuned") if at and name in CLASSICAL]
    return [*shipped(CONTROLLER), *gains, *_paths(context.incomplete, MODELS)]


def vehicles(context: "CompletionContext") -> list[str]:
    """Vehicles that ship, and files of vehicles."""
    from flytune.config.recognise import VEHICLE, shipped

    return [*shipped(VEHICLE), *_paths(context.incomplete, VEHICLE_FILES)]


def edits(context: "CompletionContext") -> list[str]:
    """The fields of the task; and vehicles, once `vehicle=` is typed."""
    from flytune.config.recognise import VEHICLE, shipped

    field, equals, typed = context.incomplete.partition("=")
    if equals:
        vehicles = [*shipped(VEHICLE), *_paths(typed, TASK_FILES)] if field == "vehicle" else []
        return [f"vehicle={each}" for each in vehicles]
    from flytune.config import document, nested
    from flytune.task.files import load_task

    task = context.get("TASK")
    tables = document.plain(load_task((task.raw if task else None) or "baseline"))
    return ["vehicle=", *(f"{path}=" for path, _ in nested.leaves(tables, skip=nested.LABELS))]


def columns(context: "CompletionContext") -> list[str]:
    """The quantities of a log."""
    from flytune.evaluation.log_columns import QUANTITIES

    return [f"{each}=" for each in QUANTITIES]


def _paths(typed: str, suffixes: tuple[str, ...]) -> Iterator[str]:
    """Run directories, folders with a slash behind them, and files with one of the suffixes, that a path may mean."""
    from flytune.config.recognise import is_run

    folder, _, beginning = typed.rpartition("/")
    where = f"{folder}/" if "/" in typed else ""
    try:
        entries = sorted(os.scandir(where or "."), key=lambda each: each.name)
    except OSError:
        return
    for each in entries:
        if not each.name.startswith(beginning) or (each.name.startswith(".") and not beginning):
            continue
        if each.is_dir():
            yield f"{where}{each.name}" + "/" * (not is_run(each.path))
        elif each.name.endswith(suffixes):
            yield f"{where}{each.name}"
