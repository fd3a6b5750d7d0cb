"""flytune/Hover-v0: what Gymnasium and its users expect of an environment."""

import copy
import pickle
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="needs flytune[gymnasium]")
pytest.importorskip("PIL", reason="needs flytune[gymnasium]")

from gymnasium.error import InvalidAction, ResetNeeded  # noqa: E402
from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode, SyncVectorEnv  # noqa: E402

from flytune.adapters import registration  # noqa: E402
from flytune.adapters.gymnasium import HoverEnv, HoverVectorEnv  # noqa: E402
from flytune.errors import BadInput  # noqa: E402
from flytune.task.files import load_task  # noqa: E402

NUMBER = 6  # of every vector here and in test_batch: one compiled program serves them all
ROOT = Path(__file__).parents[2]
HOVER = np.zeros(4, np.float32)
QUIET = {f"noise.{block}": 0.0 for block in ("position", "attitude", "velocity", "body_rate")}
FIXED = {
    "initial_state.lowest_position": [0.3, -0.2, 0.8],
    "initial_state.highest_position": [0.3, -0.2, 0.8],
    "initial_state.largest_tilt": 0.0,
    "initial_state.largest_yaw": 0.0,
}


@pytest.fixture
def quiet():
    """Warnings are errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.fixture
def one():
    """One environment, begun."""
    env = HoverEnv()
    env.reset(seed=3)
    return env


def random_actions(steps, *shape):
    """Actions that sooner or later end every episode."""
    return np.random.default_rng(7).uniform(-1, 1, (steps, *shape, 4)).astype(np.float32)


# --- as Gymnasium wants it ---


@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
def test_check_env_says_only_that_the_observation_is_unbounded(quiet, render_mode):
    for infinite in ("minimum value is -infinity", "maximum value is infinity"):
        warnings.filterwarnings("ignore", message=f".*A Box observation space {infinite}")
    check_env(gymnasium.make("flytune/Hover-v0", render_mode=render_mode).unwrapped)


@pytest.mark.floor
def test_an_episode_through_make_passes_the_passive_checker(quiet):
    env = gymnasium.make("flytune/Hover-v0", render_mode="rgb_array", edits={"horizon": 20})
    env.reset(seed=0)
    ends = [env.step(HOVER)[2:4] for _ in range(20)]
    assert ends == [(False, False)] * 19 + [(False, True)]
    assert env.render().shape == (480, 480, 3)
    env.close()


def python(script, folder=None):
    """What a fresh interpreter prints."""
    answer = subprocess.run(
        [sys.executable, "-c", script], cwd=folder, capture_output=True, text=True, timeout=300, check=False
    )
    assert answer.returncode == 0, f"{script}\n{answer.stderr}"
    return answer.stdout.split()


def test_make_works_without_another_import():
    script = "import gymnasium; print(gymnasium.make('flytune.adapters.registration:flytune/Hover-v0').spec.id)"
    assert python(script) == ["flytune/Hover-v0"]


def test_registration_leaves_jax_alone():
    script = (
        "import gymnasium, sys, flytune.adapters.registration; print('jax' in sys.modules, len(gymnasium.registry))"
    )
    assert python(script)[0] == "False"


def test_registering_twice_says_nothing(quiet):
    registration.register()
    assert gymnasium.spec("flytune/Hover-v0").vector_entry_point == "flytune.adapters.gymnasium:HoverVectorEnv"


@pytest.mark.floor
def test_the_vector_env_is_what_make_vec_makes_and_says_how_it_resets(quiet):
    envs = gymnasium.make_vec("flytune/Hover-v0", num_envs=NUMBER, task="acrobatic")
    assert isinstance(envs, HoverVectorEnv) and envs.task.name == "acrobatic"
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    observation, infos = envs.reset(seed=0)
    assert observation in envs.observation_space and infos == {}
    assert gymnasium.wrappers.vector.RecordEpisodeStatistics(envs).step(envs.action_space.sample())[0].shape == (
        NUMBER,
        17,
    )


def test_every_door_has_the_same_spaces():
    one, many = HoverEnv(), HoverVectorEnv(NUMBER)
    assert one.observation_space == many.single_observation_space == gymnasium.spaces.Box(-np.inf, np.inf, (17,))
    assert one.action_space == many.single_action_space == gymnasium.spaces.Box(-1, 1, (4,))
    assert many.observation_space.shape == (NUMBER, 17) and many.action_space.shape == (NUMBER, 4)


# --- one environment ---


def test_the_reward_is_the_sum_of_its_terms(one):
    for action in random_actions(10):
        _, reward, _, _, info = one.step(action)
        assert set(info["reward_terms"]) == set(one.task.reward)
        assert sum(info["reward_terms"].values()) == pytest.approx(reward, abs=1e-6)


def test_a_seed_fixes_the_start_the_noise_and_the_episodes_after_it(one):
    def fly(env):
        first = [env.reset(seed=11)[0], *(env.step(action)[0] for action in random_actions(5))]
        return np.array([*first, env.reset()[0], env.step(HOVER)[0]])

    flown = fly(one)
    np.testing.assert_array_equal(flown, fly(one))
    np.testing.assert_array_equal(flown, fly(HoverEnv()))
    assert not np.allclose(flown[0], flown[6], atol=1e-2)  # the second episode starts elsewhere
    assert not np.allclose(flown[0], one.reset(seed=12)[0], atol=1e-2)


def test_observations_carry_the_task_s_noise():
    env = HoverEnv(edits={"noise.position": 0.05})
    seen = np.array([env.reset(options={"position": [0.0, 0.0, 1.0]})[0][:3] for _ in range(300)])
    # 900 draws: the standard deviation's own is 0.05 / sqrt(1800) = 0.0012, six of them
    assert seen.std() == pytest.approx(0.05, abs=0.007)


def test_a_failure_names_its_condition_and_an_ended_episode_needs_a_reset(one):
    one.reset(options={"position": [0.0, 0.0, 0.05]})
    _, _, terminated, truncated, info = one.step(HOVER)
    assert (terminated, truncated, info["termination"]) == (True, False, "altitude")
    with pytest.raises(ResetNeeded, match="after the end"):
        one.step(HOVER)
    one.reset()
    assert one.step(HOVER)[4]["termination"] is None


def test_a_start_can_be_given():
    env = HoverEnv(edits=QUIET)
    observation, _ = env.reset(options={"position": [0.5, -0.25, 1.5], "yaw": np.pi / 2})
    # e_p = (0.5, -0.25, 1.5) - (0, 0, 1); a quarter turn about z is (0, 0, sin 45 deg, cos 45 deg)
    expected = [0.5, -0.25, 0.5, 0, 0, np.sqrt(0.5), np.sqrt(0.5), *[0] * 10]
    np.testing.assert_allclose(observation, expected, atol=1e-6)


@pytest.mark.parametrize(
    "options",
    [
        {"positions": [0, 0, 1]},
        {"yaw": 1.0},
        {"position": [0, 0]},
        {"position": "here"},
        {"position": [0, 0, np.nan]},
        {"position": [0, 0, 1], "yaw": [1.0, 2.0]},
        {"position": [0, 0, 1e9]},
    ],
)
def test_impossible_starts_are_refused_in_one_line(one, options):
    with pytest.raises(BadInput, match=r"^options\.[^\n]*Allowed:[^\n]*$"):
        one.reset(options=options)


@pytest.mark.parametrize("simulator", ["flytune", "pybullet", "mujoco"])
def test_other_worlds_are_judged_as_our_own(simulator):
    if simulator != "flytune":
        pytest.importorskip(simulator, reason=f"needs flytune[{simulator}]")
    given = {"position": [0.4, -0.3, 1.2], "yaw": 0.5}
    # without drag and noise, hovering level: every simulator stands still, so all must be judged alike
    ours = HoverEnv(edits=QUIET)
    other = HoverEnv(
        edits=QUIET, simulator=simulator, simulator_options={"physics_steps": 1} if simulator == "flytune" else None
    )
    seen = [env.reset(options=given)[0] for env in (ours, other)]
    np.testing.assert_allclose(*seen, atol=1e-6)
    for action in [HOVER] * 5 + [np.full(4, 0.1)] * 5:
        (first, reward, *ends, info), (second, other_reward, *other_ends, other_info) = (
            ours.step(action),
            other.step(action),
        )
        # ten steps of 0.01 s under a tenth more thrust: 2 mm; integrators differ by a part of that
        np.testing.assert_allclose(first, second, atol=3e-3)
        assert reward == pytest.approx(other_reward, abs=3e-3)
        assert ends == other_ends == [False, False]
        assert set(info["reward_terms"]) == set(other_info["reward_terms"])
    np.testing.assert_allclose(second[13:], 0.1)  # the last action is told on
    other.close()
    other.close()


def test_our_own_world_judges_a_wild_flight_exactly_as_the_core(one):
    other = HoverEnv(simulator="flytune", simulator_options={"physics_steps": 1})
    one.reset(seed=4)
    other.reset(seed=4)
    for action in random_actions(30):
        first, second = one.step(action), other.step(action)
        # the same float32 arithmetic in two programs; the world hands positions on as float64
        np.testing.assert_allclose(first[0], second[0], rtol=1e-4, atol=1e-4)
        assert first[1] == pytest.approx(second[1], abs=1e-4)
        assert first[2:4] == second[2:4] and first[4]["termination"] == second[4]["termination"]
        if first[2]:
            return
    pytest.fail("the flight was to end")


# --- many ---


def test_the_vector_env_flies_as_the_single_one_does():
    edits = QUIET | FIXED | {"horizon": 6}
    env, envs = HoverEnv(edits=edits), HoverVectorEnv(NUMBER, edits=edits)
    seen = (env.reset(seed=0)[0], envs.reset(seed=5)[0][0])
    np.testing.assert_allclose(*seen, atol=1e-6)
    for action in random_actions(6):
        observation, reward, terminated, truncated, info = env.step(action)
        _, rewards, terminations, truncations, infos = envs.step(np.tile(action, (NUMBER, 1)))
        assert (terminated, truncated) == (terminations[0], truncations[0])
        assert rewards[0] == pytest.approx(reward, abs=1e-5)
    assert truncated
    np.testing.assert_allclose(infos["final_obs"][0], observation, rtol=1e-5, atol=1e-5)
    assert infos["final_info"]["reward_terms"]["attitude"][0] == pytest.approx(
        info["reward_terms"]["attitude"], abs=1e-6
    )
    np.testing.assert_allclose(envs.step(np.zeros((NUMBER, 4)))[0][0, :3], [0.3, -0.2, -0.2], atol=1e-3)  # begun anew


def structure(infos, ended):
    """Keys, types and shapes of infos, and what each mask says of which environments ended."""
    described = {}
    for name, value in infos.items():
        if isinstance(value, dict):
            described[name] = structure(value, ended)
        elif name.startswith("_"):
            described[name] = "the ended" if (value == ended).all() else "the others" if (value != ended).all() else "?"
        else:
            described[name] = (value.dtype, value.shape)
    return described


def test_infos_have_the_form_of_gymnasium_s_own_vector_env():
    envs = HoverVectorEnv(NUMBER)
    own = SyncVectorEnv([HoverEnv] * NUMBER, autoreset_mode=AutoresetMode.SAME_STEP)
    found = []
    for candidate in (envs, own):
        forms = {}
        assert candidate.reset(seed=0)[1] == {}
        for actions in random_actions(80, NUMBER):
            observation, reward, terminated, truncated, infos = candidate.step(actions)
            ended = terminated | truncated
            kind = "some" if ended.any() and not ended.all() else "all" if ended.all() else "none"
            types = (observation.dtype, reward.dtype, terminated.dtype, truncated.dtype)
            forms.setdefault(kind, (types, structure(infos, ended)))
            if kind == "some":
                index = int(np.flatnonzero(ended)[0])
                assert infos["final_obs"][index].shape == (17,)
                assert infos["final_info"]["termination"][index] in envs.task.termination
                assert all(infos["final_obs"][other] is None for other in np.flatnonzero(~ended))
        found.append(forms)
    assert {"none", "some"} <= set(found[0]) & set(found[1])
    for kind in set(found[0]) & set(found[1]):
        assert found[0][kind] == found[1][kind]


def test_when_all_end_at_once_infos_still_have_the_form_of_gymnasium_s_own():
    edits = {"horizon": 2}
    forms = []
    own = SyncVectorEnv([lambda: HoverEnv(edits=edits)] * NUMBER, autoreset_mode=AutoresetMode.SAME_STEP)
    for candidate in (HoverVectorEnv(NUMBER, edits=edits), own):
        candidate.reset(seed=0)
        candidate.step(np.zeros((NUMBER, 4)))
        _, _, terminated, truncated, infos = candidate.step(np.zeros((NUMBER, 4)))
        assert truncated.all() and not terminated.any()
        forms.append(structure(infos, truncated))
    assert forms[0] == forms[1]


def flown(envs, disabled):
    """All that twenty steps give, infos in plain form; where nothing resets by itself, the ended are reset."""
    seen = [envs.reset(seed=0)]
    for actions in random_actions(20, 1).repeat(NUMBER, axis=1):
        seen.append(envs.step(actions))
        ended = seen[-1][2] | seen[-1][3]
        if disabled and ended.any():
            with pytest.raises((ResetNeeded, AssertionError)):
                envs.step(actions)
            seen.append(envs.reset(options={"reset_mask": ended}))
    return seen


@pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.name)
def test_each_autoreset_mode_gives_what_gymnasium_s_own_vector_env_gives(mode):
    # the same start each time and no noise, so that all numbers are those of the single environment
    edits = QUIET | FIXED | {"horizon": 6}
    ours = gymnasium.make_vec("flytune/Hover-v0", num_envs=NUMBER, edits=edits, autoreset_mode=mode)
    own = SyncVectorEnv([lambda: HoverEnv(edits=edits)] * NUMBER, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] is own.metadata["autoreset_mode"] is mode
    found, wanted = (flown(envs, mode is AutoresetMode.DISABLED) for envs in (ours, own))
    assert any(step[3].all() for step in wanted if len(step) == 5)
    for mine, theirs in zip(found, wanted, strict=True):
        for one, other in zip(mine[:-1], theirs[:-1], strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)
        assert structure(mine[-1], np.ones(NUMBER, bool)) == structure(theirs[-1], np.ones(NUMBER, bool))


def test_an_autoreset_mode_that_does_not_exist_is_refused():
    for mode in ("next_step", "Never", 3, None):
        with pytest.raises(BadInput, match=r"^autoreset_mode: .* Allowed: NEXT_STEP, SAME_STEP, DISABLED\.$"):
            HoverVectorEnv(NUMBER, autoreset_mode=mode)
    assert HoverVectorEnv(NUMBER, autoreset_mode="NextStep").autoreset_mode is AutoresetMode.NEXT_STEP


@pytest.mark.parametrize("mode", ["vector_entry_point", "sync"])
def test_make_and_make_vec_keep_a_time_limit_below_the_horizon(mode):
    envs = gymnasium.make_vec("flytune/Hover-v0", num_envs=NUMBER, vectorization_mode=mode, max_episode_steps=3)
    envs.reset(seed=0)
    ends = [envs.step(np.zeros((NUMBER, 4)))[3].all() for _ in range(3)]
    assert ends == [False, False, True]


def test_a_time_limit_that_is_none_is_refused_and_one_beyond_the_horizon_changes_nothing():
    for wrong in (0, -3, 2.5, "10"):
        with pytest.raises(BadInput, match=f"max_episode_steps: {wrong!r} is not allowed"):
            HoverVectorEnv(NUMBER, max_episode_steps=wrong)
    task = load_task("baseline", {"horizon": 4})
    assert HoverVectorEnv(NUMBER, task=task, max_episode_steps=9).task.horizon == 4


def test_starts_of_many_can_be_given_one_for_all_or_one_for_each():
    envs = HoverVectorEnv(NUMBER, edits=QUIET)
    observations, _ = envs.reset(seed=0, options={"position": [0.1, 0.2, 1.3], "yaw": np.pi / 2})
    expected = [0.1, 0.2, 0.3, 0, 0, np.sqrt(0.5), np.sqrt(0.5)]
    np.testing.assert_allclose(observations[:, :7], [expected] * NUMBER, atol=1e-6)
    each = np.linspace(0.5, 1.0, NUMBER)[:, None] * [1.0, 0.0, 1.0]
    mask = np.arange(NUMBER) % 2 == 0
    later, _ = envs.reset(options={"position": each, "yaw": np.zeros(NUMBER), "reset_mask": mask})
    np.testing.assert_allclose(later[mask, :3], each[mask] - [0, 0, 1], atol=1e-6)
    np.testing.assert_array_equal(later[~mask], observations[~mask])
    with pytest.raises(BadInput, match=f"three numbers, or {NUMBER} times as many"):
        envs.reset(options={"position": np.zeros((2, 3))})


@pytest.mark.parametrize("make", [HoverEnv, lambda **given: HoverVectorEnv(NUMBER, **given)], ids=["one", "many"])
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
def test_a_copy_goes_on_as_the_original_does_and_apart_from_it(make, copied):
    env = make(edits={"horizon": 3}, render_mode="rgb_array")
    env.reset(seed=5)
    env.step(np.full(env.action_space.shape, 0.1))
    twin = copied(env)
    flights = []
    for each in (env, twin):
        each.step(np.zeros(env.action_space.shape))
        flights.append([each.reset()[0], each.step(np.zeros(env.action_space.shape))[0], *np.array(each.render())])
    for mine, theirs in zip(*flights, strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("simulator", ["pybullet", "mujoco"])
def test_an_environment_of_another_simulator_is_not_copied_half(simulator):
    pytest.importorskip(simulator, reason=f"needs flytune[{simulator}]")
    env = HoverEnv(simulator=simulator)
    for copied in (copy.deepcopy, pickle.dumps):
        with pytest.raises(BadInput, match="cannot be copied or pickled"):
            copied(env)
    env.close()


def test_the_vector_env_s_seed_and_mask():
    envs = HoverVectorEnv(NUMBER)
    first, _ = envs.reset(seed=9)
    np.testing.assert_array_equal(first, HoverVectorEnv(NUMBER).reset(seed=9)[0])
    np.testing.assert_array_equal(first, envs.reset(seed=9)[0])
    second, _ = envs.reset()
    assert not np.allclose(first, second, atol=1e-2)
    mask = np.arange(NUMBER) == 1
    third, _ = envs.reset(options={"reset_mask": mask})
    assert (np.abs(third - second).max(axis=1) > 1e-2).tolist() == mask.tolist()
    for wrong in (np.array([True]), np.zeros(NUMBER, bool), np.ones(NUMBER)):
        with pytest.raises(BadInput, match="reset_mask"):
            envs.reset(options={"reset_mask": wrong})
    with pytest.raises(BadInput, match="positions: is unknown"):
        envs.reset(options={"positions": [0, 0, 1]})


# --- misuse ---


@pytest.mark.parametrize("make", [HoverEnv, HoverVectorEnv])
def test_a_step_or_a_picture_before_the_first_reset_is_refused(make):
    env = make(render_mode="rgb_array")
    with pytest.raises(ResetNeeded):
        env.step(env.action_space.sample())
    with pytest.raises(ResetNeeded):
        env.render()


@pytest.mark.parametrize(
    "action", [np.zeros(3), np.zeros((1, 4)), 0.5, None, "up", [0, 0, 0, np.nan], [0, np.inf, 0, 0], [0, 0, 0, "a"]]
)
def test_impossible_actions_are_refused_and_nothing_moves(one, action):
    envs = HoverVectorEnv(NUMBER)
    envs.reset(seed=0)
    with pytest.raises(InvalidAction, match=r"^action: [^\n]*Allowed[^\n]*$"):
        one.step(action)
    with pytest.raises(InvalidAction, match=r"^action: [^\n]*Allowed[^\n]*$"):
        envs.step(np.full((NUMBER, 4), np.nan) if isinstance(action, list) else action)
    untouched = HoverEnv()
    untouched.reset(seed=3)
    np.testing.assert_array_equal(one.step(HOVER)[0], untouched.step(HOVER)[0])


def test_lists_and_actions_beyond_the_limits_are_fine(one):
    observation, *_ = one.step([2, -3, 0, 1])
    np.testing.assert_array_equal(observation[13:], [1, -1, 0, 1])


@pytest.mark.parametrize(
    "wrong",
    [
        {"task": "basline"},
        {"edits": {"horizon": 0}},
        {"render_mode": "human"},
        {"task": load_task("baseline"), "edits": {"horizon": 3}},
    ],
)
@pytest.mark.parametrize("make", [HoverEnv, HoverVectorEnv])
def test_impossible_arguments_are_refused_in_one_line(make, wrong):
    with pytest.raises(BadInput, match=r"^[^\n]*[Aa]llowed[^\n]*$"):
        make(**wrong)


def test_impossible_worlds_and_numbers_are_refused_in_one_line():
    with pytest.raises(BadInput, match="world: 'gazebo'"):
        HoverEnv(simulator="gazebo")
    with pytest.raises(BadInput, match="num_envs: 0"):
        HoverVectorEnv(0)


# --- pictures ---


def test_pictures_follow_the_flight():
    env = HoverEnv(render_mode="rgb_array", edits={"termination.speed.bound": 5.0})
    env.reset(seed=0, options={"position": [0.4, 0.2, 1.0]})
    first = env.render()
    for _ in range(20):
        env.step(np.full(4, 0.5))
    second = env.render()
    assert first.dtype == np.uint8 and first.shape == (480, 480, 3)
    assert (first != second).any(axis=-1).mean() > 0.02
    np.testing.assert_array_equal(second, env.render())  # looking changes nothing


@pytest.mark.floor
def test_a_vector_env_gives_a_picture_of_each():
    envs = HoverVectorEnv(NUMBER, render_mode="rgb_array", edits={"horizon": 3})
    envs.reset(seed=0)
    for _ in range(4):  # past the end: the trail begins anew
        envs.step(np.zeros((NUMBER, 4)))
    pictures = envs.render()
    assert isinstance(pictures, tuple) and [picture.shape for picture in pictures] == [(480, 480, 3)] * NUMBER
    assert (pictures[0] != pictures[1]).any()


@pytest.mark.parametrize("make", [HoverEnv, HoverVectorEnv])
def test_a_picture_nobody_asked_for_is_warned_of(make):
    env = make(NUMBER) if make is HoverVectorEnv else make()
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


# --- the page about it ---


def test_every_example_of_the_page_runs(tmp_path):
    page = (ROOT / "docs" / "how-to" / "gymnasium.md").read_text(encoding="utf-8")
    examples = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    assert len(examples) >= 3
    for example in examples:
        python(example, tmp_path)
