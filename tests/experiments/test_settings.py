"""The settings of a run that the command line asks for."""

import dataclasses
import re
from dataclasses import replace

import pytest

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.algorithms.rl import RL
from bgpo_trl.configs import PRESETS, DDPGConfig
from bgpo_trl.experiments.arguments import Arguments, command_line, run_config


def test_a_preset_is_taken_as_it_is():
    for name, preset in PRESETS.items():
        assert run_config(Arguments(preset=name)) == preset


@pytest.mark.parametrize("name", ALGORITHMS)
def test_another_algorithm_changes_nothing_else(name):
    for preset, config in PRESETS.items():
        arguments = Arguments(algorithm=name, preset=preset)
        entry = ALGORITHMS[name]
        expected = replace(config, name=name, algorithm=entry.config)
        assert run_config(arguments) == expected
        published = name.endswith("-paper")
        noise = 0.1 if entry.config.demonstration_share else 0.3
        # The same learner for all, but those as published.
        assert (entry.config.rl == DDPGConfig(noise=noise)) is not published


def test_the_command_line_names_every_algorithm(capsys):
    with pytest.raises(SystemExit):
        command_line(print, None, options=["--help"])
    told = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for name in [*ALGORITHMS, *RL]:
        # "-demonstrations" is told once, of both baselines.
        assert re.search(rf"\b{name.removesuffix('-demonstrations')}\b", told), name


@pytest.mark.parametrize("rl", RL)
@pytest.mark.parametrize("name", ["bgpo", "oracle", "ddpg"])
def test_another_rl_algorithm_changes_nothing_else(name, rl):
    plain = run_config(Arguments(algorithm=name))
    config = run_config(Arguments(algorithm=name, rl=rl))
    own = plain.algorithm.rl
    expected = own if rl == own.name else RL[rl].config
    assert config == replace(plain, algorithm=replace(plain.algorithm, rl=expected))
    assert dataclasses.asdict(config)["algorithm"]["rl"]["name"] == rl


@pytest.mark.parametrize("preset", PRESETS)
def test_tasks_of_every_preset_start_when_the_paper_has_them_start(preset):
    config = PRESETS[preset]
    shares = [start / config.episodes for start in config.task_starts]
    # The quick run leaves its last task more of its few episodes.
    paper, near = [0, 7_000 / 20_000, 13_000 / 20_000], 0.07 if preset == "quick" else 0.02
    assert shares == pytest.approx(paper, abs=near)


@pytest.mark.parametrize(
    ("preset", "episodes", "starts", "eval_every"),
    [
        ("paper", 10_000, (0, 3_500, 6_500), 1),
        ("quick", 2_400, (0, 760, 1_400), 120),
        ("quick", 20, (0, 6, 12), 20),  # tested once at least
    ],
)
def test_another_length_keeps_the_proportions(preset, episodes, starts, eval_every):
    config = run_config(Arguments(preset=preset, episodes=episodes))
    assert (config.episodes, config.task_starts) == (episodes, starts)
    assert config.eval_every == eval_every
    assert config == replace(
        PRESETS[preset], episodes=episodes, task_starts=starts, eval_every=eval_every
    )


@pytest.mark.parametrize("change", [{"seeds": (7, 9)}, {"schedule": "sequential"}])
def test_other_seeds_or_another_schedule_change_nothing_else(change):
    config = run_config(Arguments(preset="desk", **change))
    assert config == replace(PRESETS["desk"], **change)


@pytest.mark.parametrize(
    "arguments", [{"episodes": 0}, {"episodes": -3}, {"seeds": ()}, {"seeds": (2, 2)}]
)
def test_lengths_and_seeds_that_cannot_be_are_refused(arguments):
    with pytest.raises(ValueError, match=r"must be at least 1|seeds must be one or more"):
        run_config(Arguments(**arguments))
