"""Another robot than NICO, from its simulation to a policy that is loaded and filmed."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from one_shot import OneShotArguments, one_shot
from PIL import Image
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from bgpo_trl.data.dataset import load_demonstrations, write_demonstrations
from bgpo_trl.encoders.fitting import retrain_inverse
from bgpo_trl.encoders.probes import probe
from bgpo_trl.encoders.train import make_bank, train_encoders
from bgpo_trl.evaluation import evaluate_random_policy
from bgpo_trl.experiments.measure import draw, measure
from bgpo_trl.experiments.watch import WatchArguments, watch
from bgpo_trl.modules.vae import VAE
from bgpo_trl.policy import load_run
from bgpo_trl.runs.results import read_table
from bgpo_trl.scenes import SCENES, Outcome, SimulationEnv, StateColumns, find_scene
from tests.helpers import TINY_ENCODERS, finish
from tests.scenes.dot import (
    SHAPE,
    TASKS,
    Dot,
    SavedDot,
    demonstrate,
    pretrain,
    record_some,
    run_config,
    scene,
    trainer_of,
)


@pytest.fixture(scope="module")
def pretrained(tmp_path_factory):
    return pretrain(scene(), tmp_path_factory.mktemp("dot"))


@pytest.fixture
def dot(monkeypatch):
    monkeypatch.setitem(SCENES, "dot", scene())


def test_an_environment_of_a_simulation_keeps_the_promises_to_torchrl():
    env = scene().simulate(TASKS, batch_size=[2], seed=0)
    check_env_specs(env)
    start = env.reset(TensorDict({"task": torch.tensor([0, 1])}, [2]))
    assert start["pixels"].shape == (2, 16, 24, 3)
    assert env.action_spec.shape == (2, 1)
    states = [start]
    for _ in range(4):
        action = torch.tensor([[-0.5], [-0.9]])  # The first one succeeds, the second falls off.
        states.append(env.step(states[-1].clone().set("action", action))["next"])
    assert [state["success"].flatten().tolist() for state in states][-1] == [True, False]
    assert states[-1]["terminated"].all()
    assert states[-1]["done"].all()
    rewards = torch.stack([state["reward"] for state in states[1:]]).sum(0)
    assert rewards.flatten().tolist() == [1.0, 0.0]
    assert not env.reset()["done"].any()
    # Actions beyond the range count as its ends.
    state, place = env.reset(), env.simulations[0].place
    env.step(state.set("action", torch.tensor([[-3.0], [0.0]])))
    assert env.simulations[0].place == place - 0.5


class Falling(Dot):
    def step(self, action):
        return super().step(action)._replace(success=False, failure=True)


def test_a_failed_episode_is_no_success(tmp_path):
    falling = scene(lambda: Falling())
    rate = evaluate_random_policy(tasks=TASKS, episodes=4, max_steps=12, scene=falling)
    assert rate.tolist() == [0.0, 0.0]
    with pytest.raises(RuntimeError, match="the demonstrator of 'left' failed 2 times in a row"):
        record_some(tmp_path, falling, attempts=2)


REFUSED = [
    (lambda f: scene().simulate(["up"]), "has no task 'up'"),
    (lambda f: scene().simulate(["left", "left"]), "is named twice"),
    (lambda f: scene().simulate(TASKS, spread=0.5), "have no spread"),
    (lambda f: scene().simulate(TASKS, observation="state"), "has no ground truth"),
    (lambda f: scene(frame_shape=(16, 8)), "at least 16 pixels"),
    (lambda f: find_scene("dog"), "there is no scene 'dog'"),
    (lambda f: record_some(f / "new", scene(demonstrator=None)), "has no demonstrator"),
    (lambda f: scene(make_env=None).simulate(TASKS), "has no simulation: give it a make_env"),
    (lambda f: scene(make_env=Dot), "Dot is a simulation: give partial(SimulationEnv, Dot)"),
    # Names and versions that files can hold.
    (lambda f: replace(scene(), name="two dots"), "of a scene is a"),
    (lambda f: replace(scene(), name=""), "of a scene is a"),
    (lambda f: replace(scene(), version=1), "of a scene is a"),
]


@pytest.mark.parametrize(("call", "cause"), REFUSED)
def test_what_a_scene_lacks_is_refused_in_a_line(tmp_path, refused, call, cause):
    refused(lambda: call(tmp_path), cause, "")


def test_demonstrations_have_the_shapes_of_the_scene(tmp_path):
    data = record_some(tmp_path, seen())
    assert data["pixels"].shape == (4, 13, 16, 24, 3)
    assert data["action"].shape == (4, 12, 1)
    assert data["state"].shape == (4, 13, 1)
    for row in load_demonstrations(tmp_path):
        moved = 0.5 * row["action"].flatten().cumsum(0)
        length = int(row["length"])
        expected = row["state"][0, 0] + moved[: length - 1]
        torch.testing.assert_close(row["state"].flatten()[1:length], expected, atol=1e-6, rtol=0)
        assert bool(row["state"][length - 1] > 0) == bool(row["task"])  # "left" or "right"


def test_encoders_of_another_robot_are_refused_whatever_its_version(pretrained, tmp_path):
    encoders, bank = pretrained
    other = replace(scene(), name="cart")  # also of version "dot-1", as everyone writes "1"
    refusal = r"of the scene dot dot-1, this is cart dot-1.*--scene dot"
    with pytest.raises(ValueError, match=refusal):
        encoders.check_scene(other, "the encoders", "train")
    run = run_config(tasks=("grasp_glass", "push_green_to_glass"), scene="nico")
    bank = replace(bank, tasks=run.tasks)
    for given, part in ((bank, "the bank"), (replace(bank, scene=None), "encoders")):
        with pytest.raises(ValueError, match=rf"{part} is of the scene dot dot-1, this is nico"):
            trainer_of(tmp_path / "run", (encoders, given), run)
    assert not (tmp_path / "run").exists()


def test_recordings_of_another_robot_are_refused(pretrained, tmp_path):
    """They are written for a scene without a simulation, too."""
    encoders, _ = pretrained
    noise = np.random.default_rng(0).integers(256, size=(2, 2, 4, 16, 24, 3), dtype=np.uint8)
    shown = {task: [{"pixels": one} for one in noise[row]] for row, task in enumerate(TASKS)}
    dot, cart = (
        write_demonstrations(tmp_path / robot.name, shown, scene=robot, held_out_per_task=1)
        for robot in (scene(), replace(scene(), name="cart", make_env=None))
    )
    parts, options = (tmp_path / "weights", tmp_path / "log"), {"tasks": TASKS, "scene": scene()}
    for call in (
        lambda: make_bank(encoders, cart, tasks=TASKS),
        lambda: train_encoders(dot, cart, *parts, TINY_ENCODERS, **options),
        lambda: retrain_inverse(encoders, cart),
        lambda: probe(encoders, dot, play=cart),
    ):
        with pytest.raises(ValueError, match="cart shows the scene cart dot-1, the encoders dot d"):
            call()


SENTENCES = {"left": "move left, then stop", "right": "move right/away, then stop"}


class Told(SavedDot):
    """A dot whose tasks are named by sentences."""

    def reset(self, task):
        super().reset({name: short for short, name in SENTENCES.items()}[task])


def test_a_run_learns_on_another_robot_and_is_loaded_and_filmed(tmp_path, monkeypatch):
    """Its tasks have names that commas and slashes could tear apart."""
    names = tuple(SENTENCES.values())
    short = {name: task for task, name in SENTENCES.items()}
    told = scene(
        Told,
        demonstrator=lambda robot, task, seed: demonstrate(robot, short[task], seed),
        tasks=names,
        default_tasks=names,
        rate=12.5,
    )
    monkeypatch.setitem(SCENES, "dot", told)
    encoders, bank = pretrain(told, tmp_path, per_task=4)
    with trainer_of(tmp_path / "run", (encoders, bank), run_config(tasks=names)) as trainer:
        trainer.run()
        summary = measure(trainer, bank, tmp_path / "run")
        draw(trainer, bank, tmp_path / "run", summary)
    table = read_table(tmp_path / "run" / "train.csv")
    assert (len(table), {*table["task"]}) == (8, {*names})
    films = [*(tmp_path / "run" / "figures").glob("move*.gif")]
    assert len(films) == 2
    assert Image.open(films[0]).info["duration"] == 80  # ms a frame, as fast as the robot

    # The encoders do not come with the scene: the run keeps them.
    policy = load_run(tmp_path / "run")
    assert policy.encoders.identity == encoders.identity
    assert policy.bank.tasks == names
    policy.condition(np.zeros((3, 16, 24, 3), np.uint8), task=names[0])
    assert policy.act(np.zeros((16, 24, 3), np.uint8)).shape == (1,)
    with pytest.raises(ValueError, match=r"a frame is uint8 \[16, 24, 3\], got .*\[32, 64, 3\]"):
        policy.act(np.zeros((32, 64, 3), np.uint8))
    outcomes = watch(WatchArguments(run=tmp_path / "run"))
    assert f"{names[0]}: " in outcomes
    assert (tmp_path / "run" / "figures" / "film.gif").exists()
    one_shot(OneShotArguments(run=tmp_path / "run", shares=(1.0,), episodes=2))
    assert {*read_table(tmp_path / "run" / "one_shot.csv")["task"]} == {*names}


class Thrifty(Dot):
    """A dot that draws into one array, and halves actions in place."""

    def __init__(self):
        super().__init__()
        self.drawn = np.zeros((16, 24, 3), np.uint8)

    def frame(self):
        self.drawn[:] = super().frame()
        return self.drawn

    def step(self, action):
        action *= 0.5
        return super().step(2 * action)


def thrifty(robot, task, seed):
    act, action = demonstrate(robot, task, seed), np.zeros(1)

    def again():
        action[:] = act()
        return action

    return again


def test_arrays_may_be_used_again(tmp_path):
    """A recording keeps what a simulation and a demonstrator changed later."""
    plain = record_some(tmp_path / "plain", scene(), per_task=np.int64(2))
    found = record_some(tmp_path / "thrifty", scene(Thrifty, demonstrator=thrifty))
    for key, values in plain.items():
        assert found[key].equal(values), key


class Walker(Dot):
    """A dot that is slow, with a second action that does nothing, in large square frames."""

    def step(self, action):
        return super().step(0.05 * action)

    def frame(self):
        frame = np.zeros((48, 48, 3), np.uint8)
        frame[6:10, round(5 + 5 * self.place) :][:, :4] = 255
        return frame


def test_frames_actions_and_episodes_have_any_size(tmp_path):
    rng = np.random.default_rng(0)
    shown = {
        task: [
            {
                "pixels": rng.integers(0, 256, (length, 48, 48, 3), dtype=np.uint8),
                "action": np.zeros((length - 1, 2)),
            }
            for length in (57, 58, 59)
        ]
        for task in TASKS
    }
    walker = scene(Walker, max_steps=60, frame_shape=(48, 48), action_size=2)
    SCENES["dot"] = walker
    dataset = write_demonstrations(tmp_path / "own", shown, scene=walker, held_out_per_task=1)
    paths = tmp_path / "encoders.safetensors", tmp_path / "log"
    options = {"tasks": TASKS, "scene": walker, "progress": False}
    pretrained = train_encoders(dataset, None, *paths, TINY_ENCODERS, **options)
    config = run_config(algorithm={"max_steps": 60}, episodes=2)
    finish(trainer_of(tmp_path / "run", pretrained, config))
    steps = read_table(tmp_path / "run" / "train.csv")["steps"].astype(int)
    assert steps.max() == 60
    policy = load_run(tmp_path / "run")
    frames = shown["left"][0]["pixels"]
    policy.condition(frames)
    assert policy.act(frames[0]).shape == (2,)


RETURNED = [
    ("frame", np.ones((16, 24, 3), np.float32), r"float32 \[16, 24, 3\]: return uint8 \[16, 24"),
    ("frame", np.ones((24, 16, 3), np.uint8), r"uint8 \[24, 16, 3\]: return uint8"),
    ("frame", np.ones((16, 24, 1), np.uint8), r"uint8 \[16, 24, 1\]: return uint8"),
    ("step", True, "True: return an Outcome, whose"),  # was an error of unpacking
    ("step", (np.zeros(1), 0.0, False, False, {}), r"\(array\(\[0"),  # Gym's
    ("step", (True, False), r"\(True, False\)"),
    ("step", Outcome(success=0.5), r"Outcome\(succ"),  # paid half a reward
    ("step", Outcome(success=np.nan), r"Outcome\(succ"),
    ("step", None, "None"),
    ("state", None, "None: return 1 finite numbers"),  # a forgotten return was NaN
    ("state", [np.nan], r"\[nan\]"),
    ("state", [1e39], r"\[1e\+39\]"),  # inf as float32
    ("state", [0.0, 1.0], r"\[0.0, 1.0\]"),
    ("state", 0.0, "0.0"),
    ("state", ["far"], r"\['far'\]"),
]


class Seen(Dot):
    """A dot with ground truth."""

    def state(self):
        return np.array([self.place])


def seen(make=Seen):
    return scene(make, state=StateColumns(center=(0.0,), scale=(1.0,)))


@pytest.mark.parametrize(("method", "value", "message"), RETURNED)
def test_what_a_simulation_returns_is_checked(tmp_path, method, value, message):
    odd = seen(type("Odd", (Seen,), {method: lambda *_: value}))
    for call in (
        lambda: odd.simulate(TASKS, observation="both").rollout(2),
        lambda: record_some(tmp_path, odd),
    ):
        with pytest.raises(ValueError, match=rf"Odd\.{method}\(\) returned {message}"):
            call()


@pytest.mark.parametrize("named", [{"angles": {"cup": 2}}, {"places": {"cup": (0, -1, 2)}}])
def test_columns_that_the_ground_truth_lacks_are_refused(named):
    with pytest.raises(ValueError, match=r"'cup' is read from column -?\d .* has 2: correct"):
        StateColumns(center=(0.0, 0.0), scale=(1.0, 1.0), **named)


@pytest.mark.parametrize(
    "column", [(0.0, 0.0), (0.0, np.inf), (np.nan, 1.0), (0.0, -1.0), (0.1, 1.4e-17), (0.0, 1e-46)]
)
def test_a_ground_truth_is_divided_by_numbers_above_zero(column):
    """The deviation of a constant column is 0, and policies observed NaN."""
    center, scale = column
    with pytest.raises(ValueError, match=r"column 1 .* the scale .*, such as 1 for a constant"):
        StateColumns(center=(0.0, center), scale=(1.0, scale))


def test_columns_of_numpy_are_plain_numbers():
    """Of those, torch makes float64, with which networks do not compute."""
    means = np.array([0.25, 1.5])
    for center, scale in ((means, means), ([*means], (*means,)), ([0, 1], np.float32([1, 2]))):
        columns = StateColumns(center=center, scale=scale)
        for given, found in ((center, columns.center), (scale, columns.scale)):
            assert found == (*given,)
            assert torch.tensor(found).dtype == torch.float32


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([1.5], "has an action of size 1.5: scale actions"),
        ([-1.0001], "has an action of size 1.0001: scale actions"),
        ([np.nan], r"has the action \[nan\]: give 1, finite"),
        ([0.5, 0.5], r"has the action \[0.5, 0.5\]: give 1, finite"),
    ],
)
def test_actions_of_a_demonstrator_are_checked_as_those_of_a_dataset(tmp_path, action, message):
    bold = scene(demonstrator=lambda robot, task, seed: lambda: np.array(action))
    with pytest.raises(ValueError, match=f"an episode of the demonstrator of 'right' {message}"):
        record_some(tmp_path, bold, tasks=["right"])


def test_a_run_whose_encoders_could_not_be_loaded_again_does_not_begin(pretrained, dot, tmp_path):
    class Mine(VAE):
        """A frame encoder that sees something else than its weights say."""

        def features(self, frames):
            return super().features(255 - frames)

    encoders, bank = pretrained
    mine = Mine(64, 1, (16, 24))
    mine.load_state_dict(encoders.frame_network.state_dict())
    parts = replace(encoders, frame_network=mine), replace(bank, encoder_id=None)
    refusal = r"could be saved, but not loaded again .*depends on more than"
    with pytest.raises(ValueError, match=refusal):
        trainer_of(tmp_path / "run", parts)
    assert not (tmp_path / "run").exists()


def test_episodes_are_no_longer_than_those_of_the_scene(pretrained, dot, tmp_path):
    config = run_config(algorithm={"max_steps": 13})
    refusal = "max_steps is 13, episodes of the scene 'dot' have at most 12"
    with pytest.raises(ValueError, match=refusal):
        trainer_of(tmp_path / "run", pretrained, config)

    class Stuck(Dot):
        steps = 0

        def step(self, action):
            Stuck.steps += 1
            return Outcome(success=False)

    evaluate_random_policy(tasks=TASKS, episodes=1, scene=scene(Stuck))
    assert Stuck.steps == 2 * 12


def test_a_ground_truth_that_the_simulation_does_not_have_is_named():
    env = SimulationEnv(Dot, TASKS, state_size=1, observation="both", **SHAPE)
    with pytest.raises(NotImplementedError, match=r"Dot does not define state\(\)"):
        env.reset()


def test_a_run_whose_simulation_cannot_be_saved_is_not_resumed(pretrained, dot, tmp_path, refused):
    with pytest.warns(UserWarning, match="'dot' cannot be saved: if it is interrupted"):
        finish(trainer_of(tmp_path, pretrained, run_config(episodes=2)))
    again = partial(trainer_of, tmp_path, pretrained, resume=True)
    refused(again, "simulations of the scene 'dot' cannot be saved", "begin another")


def test_all_tasks_are_those_that_it_has_unless_it_says_which():
    robot = scene(default_tasks=("left",))
    assert robot.all_tasks == ("left", "right")
    assert replace(robot, own_tasks=("right",)).all_tasks == ("right",)
