"""Settings of a run: presets, flags on top, and files of settings."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import yaml

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.configs import PRESETS, RepresentationConfig
from bgpo_trl.experiments.arguments import Arguments, EncodersArguments
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.experiments.settings import run_config
from bgpo_trl.runs.config_file import Digests, read_encoder_settings, settings_of
from bgpo_trl.scenes import SCENES
from suites import nico
from tests.scenes import dot

ONE, TWO, THREE = nico.PAPER_TASKS


def test_presets_and_algorithms_change_nothing_else():
    assert run_config(Arguments()) == PRESETS["quick"]
    for preset, config in PRESETS.items():
        assert run_config(Arguments(preset=preset)) == config
        for name, entry in ALGORITHMS.items():
            expected = replace(config, name=name, algorithm=entry.config)
            assert run_config(Arguments(algorithm=name, preset=preset)) == expected


@pytest.mark.parametrize(
    ("preset", "episodes", "starts", "eval_every"),
    [
        ("paper", 10_000, (0, 3_500, 6_500), 1),
        ("quick", 2_400, (0, 760, 1_400), 150),
        ("quick", 20, (0, 6, 12), 20),  # tested once at least
    ],
)
def test_another_length_scales_the_task_starts(preset, episodes, starts, eval_every):
    config = run_config(Arguments(preset=preset, episodes=episodes))
    assert config == replace(
        PRESETS[preset], episodes=episodes, task_starts=starts, eval_every=eval_every
    )


def test_a_flag_changes_its_setting_alone():
    changes = {"seeds": (7, 9), "task_starts": (0, 5, 5), "schedule": "sequential", "eval_every": 7}
    changes |= {"eval_episodes": 3, "checkpoint_minutes": 1.0, "spread": 0.5, "held_out": "test"}
    for name, value in changes.items():
        config = run_config(Arguments(preset="desk"), changes={"seeds": None, name: value})
        assert config == replace(PRESETS["desk"], **{name: value})
        values = map(str, value if isinstance(value, tuple) else [value])
        flags = (f"--{name.replace('_', '-')}", *values)
        assert run_config(Arguments(preset="desk", settings=flags)) == config

    flags = ("--algorithm.beta", "0.2", "--algorithm.rl.hidden-sizes", "32", "16")
    config = run_config(Arguments(algorithm="bgpo-single", settings=flags))
    expected = run_config(Arguments(algorithm="bgpo-single"))
    rl = replace(expected.algorithm.rl, hidden_sizes=(32, 16))
    assert config == replace(expected, algorithm=replace(expected.algorithm, beta=0.2, rl=rl))


@pytest.mark.parametrize(
    ("tasks", "episodes", "starts"),
    [
        ((TWO,), None, (0,)),
        ((TWO, ONE), 100, (0, 50)),
        ((THREE, ONE, TWO), None, (0, 570, 1_050)),  # as many as the preset has
        (("all",), 4_000, tuple(range(0, 4_000, 500))),
    ],
)
def test_tasks_start_in_their_order_at_even_intervals(tasks, episodes, starts):
    config = run_config(Arguments(tasks=tasks, episodes=episodes))
    assert config.tasks == (nico.ALL_TASKS if tasks == ("all",) else tasks)
    assert config.task_starts == starts
    asked = Arguments(tasks=tasks, episodes=episodes)
    assert run_config(asked, from_start=True).task_starts == (0,) * len(starts)


def test_a_file_changes_the_preset_and_flags_change_the_file(tmp_path):
    path = tmp_path / "mine.json"
    content = {"name": "bgpo-single", "eval_every": 6, "algorithm": {"beta": 0.2, "rl": {"tau": 1}}}
    path.write_text(json.dumps(content))
    single = ALGORITHMS["bgpo-single"].config
    algorithm = replace(single, beta=0.2, rl=replace(single.rl, tau=1.0))
    expected = replace(PRESETS["desk"], name="bgpo-single", eval_every=6, algorithm=algorithm)
    of_file = Arguments(config=path, preset="desk")
    assert run_config(of_file) == expected
    flags = replace(of_file, settings=("--algorithm.beta", "0.7", "--eval-every=9"))
    changed = replace(expected, eval_every=9, algorithm=replace(algorithm, beta=0.7))
    assert run_config(flags) == changed
    assert run_config(replace(of_file, algorithm="bgpo-single")) == expected  # named once more
    with pytest.raises(ValueError, match=r"--algorithm maml: .* hyperparameters of bgpo-single"):
        run_config(replace(of_file, algorithm="maml"))
    del content["name"]
    path.write_text(json.dumps(content))
    assert run_config(replace(of_file, algorithm="bgpo-single")) == expected


def test_a_file_that_gives_length_or_tasks_alone_gets_starts_that_fit(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("episodes: 1000")
    assert run_config(Arguments(config=path)) == run_config(Arguments(episodes=1_000))
    path.write_text(f"episodes: 100\ntasks: [{ONE}, {TWO}]")
    assert run_config(Arguments(config=path)).task_starts == (0, 50)
    late = Arguments(episodes=12, settings=("--task-starts", "0", "5", "12"))
    with pytest.raises(ValueError, match="task_starts must be below the 12 episodes"):
        run_config(late)


def test_a_file_may_name_the_scene_whose_tasks_and_length_are_then_the_usual_ones(
    tmp_path, monkeypatch
):
    monkeypatch.setitem(SCENES, "dot", dot.scene())
    path = tmp_path / "mine.yaml"
    for content, length in (("", 12), ("algorithm: {max_steps: 010}", 10)):  # 8 in YAML 1.1
        path.write_text(f"scene: dot\n{content}")
        of_file = run_config(Arguments(config=path))
        path.write_text(content or "{}")
        of_flag = run_config(Arguments(config=path, scene="dot"))
        assert of_file == of_flag
        assert (of_file.scene, of_file.algorithm.max_steps) == ("dot", length)
        assert of_file.tasks == SCENES["dot"].default_tasks
        path.write_text(f"scene: dot\n{content}")
        other = run_config(Arguments(config=path, algorithm="clone")).algorithm
        assert other == replace(ALGORITHMS["clone"].config, max_steps=length)


def test_a_file_sets_what_encoders_train_with_and_flags_change_the_file(tmp_path):
    (path := tmp_path / "mine.yaml").write_text("seed: 3\nvae: {steps: 7, kl_weight: 1e-3}")
    found: list[EncodersArguments] = []

    def encoders(arguments: EncodersArguments) -> None:
        found.append(arguments)

    flags = ["shown", "played", "--settings", str(path), "--config.vae.steps", "9", "--folder", "f"]
    command_line(encoders, flags)
    usual = RepresentationConfig()
    config = replace(usual, seed=3, vae=replace(usual.vae, steps=9, kl_weight=1e-3))
    expected = EncodersArguments(
        dataset=Path("shown"), play=Path("played"), settings=path, config=config, folder=Path("f")
    )
    assert found == [expected]


YAML = """
name: bgpo-single
seeds: [3, 5]
tasks: [grasp_glass, push_green_to_glass]
task_starts: [0, 300]  # the second task from episode 301
episodes: 600
spread: 1  # a whole number for a share
algorithm:
  <<: {beta: 0.5, max_steps: 50}
  beta: 0.2  # in place of the one that is merged
  rl: {learning_rate: 3e-4}
"""


def test_yaml_json_and_flags_store_the_same_settings(tmp_path):
    in_yaml, in_json = tmp_path / "mine.yaml", tmp_path / "mine.json"
    in_yaml.write_text(YAML)
    content = yaml.safe_load(YAML)
    content["algorithm"]["rl"]["learning_rate"] = 0.0003  # in YAML 1.1, the above is a text
    in_json.write_text(json.dumps(content))
    flags = Arguments(
        algorithm="bgpo-single",
        tasks=("grasp_glass", "push_green_to_glass"),
        episodes=600,
        settings=(
            *("--seeds", "3", "5", "--spread", "1"),
            *("--algorithm.beta", "0.2", "--algorithm.rl.learning-rate", "3e-4"),
        ),
    )
    asked = (flags, Arguments(config=in_yaml), Arguments(config=in_json))
    stored = [settings_of(run_config(given), Digests("a", "b")) for given in asked]
    assert stored[0] == stored[1] == stored[2]
    assert stored[0]["algorithm"]["beta"] == 0.2


@pytest.mark.parametrize(
    ("name", "content", "cause"),
    [
        ("mine.yaml", "seeds: [0, 1\nepisodes: 5", "line 2"),
        ("mine.yaml", "- seeds", "name: value"),
        ("mine.yaml", "bank: own.safetensors", "unknown setting bank"),
        ("mine.yaml", "tasks: &all [*all]", "unhashable"),
        (
            "mine.yaml",
            "episodes: 1:30",
            "episodes must be a whole number, got 1:30",
        ),  # 90 in YAML 1.1
        ("mine.yaml", "seeds: !!python/tuple [1]", "line 1"),
        ("mine.yaml", "seeds: [0]\nname: x\nseeds: [1]", "line 3 cannot be read ('seeds' is given"),
        ("mine.yml", "algorithm:\n  rl: {beta: 1, beta: 2}", "line 2 cannot be read ('beta' is"),
        ("mine.yaml", "seeds: [0]\n'seeds': [0]", "line 2 cannot be read ('seeds' is given twice)"),
        ("mine.json", '{"seeds": [0], "name": "x", "seeds": [1]}', "('seeds' is given twice)"),
        ("config.json", '{"algorithm": {"rl": {"tau": 1, "tau": 1}}}', "('tau' is given twice)"),
    ],
)
def test_a_file_that_is_damaged_or_has_wrong_settings_is_refused(
    tmp_path, refused, name, content, cause
):
    path = tmp_path / name
    path.write_text(content)
    refused(lambda: run_config(Arguments(config=path)), cause, str(path))


def test_a_wrong_file_of_encoder_settings_is_refused(tmp_path, refused):
    path = tmp_path / "mine.yaml"
    path.write_text("vae: {stepps: 7}")
    read = partial(read_encoder_settings, path, RepresentationConfig())
    refused(read, "unknown setting vae.stepps", str(path))
    path.write_text("vae: {steps: 0}")
    refused(read, "vae: steps must be at least 1", str(path))
