"""Settings read back from config.json."""

import json
from dataclasses import asdict, dataclass, field, replace

import pytest

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.configs import PRESETS, BGPOConfig, GWRBConfig, RLConfig, RunConfig
from bgpo_trl.configs.encoders import VAEConfig
from bgpo_trl.runs.config_file import Digests, read_config, settings_of
from suites import nico


def write(path, config, **changes):
    path.write_text(json.dumps({**settings_of(config, Digests("abc", "def")), **changes}))
    return path


def test_settings_are_read_as_they_were_written(tmp_path):
    for name, entry in ALGORITHMS.items():
        rl = replace(entry.config.rl, hidden_sizes=(5, 7), gamma=0.5)
        algorithm = replace(entry.config, state_limit=4.0, rl=rl)
        config = replace(PRESETS["quick"], name=name, algorithm=algorithm, checkpoint_minutes=3)
        read, digests = read_config(write(tmp_path / "config.json", config))
        assert (read, digests) == (config, Digests(encoders="abc", bank="def"))
        assert type(read.algorithm) is type(algorithm)


@dataclass(frozen=True)
class CoarseConfig(BGPOConfig):
    coarse: GWRBConfig | None = None


@pytest.mark.parametrize("coarse", [None, GWRBConfig(activity_threshold=0.777)])
def test_hyperparameters_of_an_unknown_algorithm_have_the_stored_class(tmp_path, coarse):
    config = RunConfig(name="mine", algorithm=CoarseConfig(coarse=coarse))
    path = write(tmp_path / "config.json", config)
    read = read_config(path)[0].algorithm
    assert type(read) is CoarseConfig and read.coarse == coarse
    path.write_text(path.read_text().replace("null", "7").replace("0.777", '"high"'))
    with pytest.raises(ValueError, match=r"algorithm(: |\.)coarse"):
        read_config(path)


@dataclass(frozen=True)
class ListConfig(BGPOConfig):
    widths: list[int] = field(default_factory=lambda: [1, 2])


@dataclass(frozen=True)
class MixedConfig(BGPOConfig):
    rate: int | float = 0.5


@dataclass(frozen=True)
class FadingRL(RLConfig):
    fade: float = 0.5


def test_settings_that_could_not_be_read_are_not_made():
    @dataclass(frozen=True)
    class Local(BGPOConfig):
        extra: int = 1

    for algorithm, cause in (
        (Local(), "whose hyperparameters"),
        (BGPOConfig(rl=FadingRL()), "rl.fade"),
    ):
        with pytest.raises(ValueError, match=f"could not hold these settings .*{cause}"):
            settings_of(RunConfig(name="mine", algorithm=algorithm), Digests("abc", "def"))
    with pytest.raises(ValueError, match="rl must be RLConfig"):
        BGPOConfig(rl=VAEConfig())  # pyright: ignore[reportArgumentType]
    for kind, name in ((ListConfig, "widths"), (MixedConfig, "rate")):
        with pytest.raises(ValueError, match=f"{name} is annotated .*, which config.json cannot"):
            kind()


def test_missing_settings_get_their_defaults(tmp_path):
    settings = asdict(RunConfig())
    del settings["checkpoint_minutes"], settings["algorithm"]["rl"]["critic_layer_norm"]
    (tmp_path / "config.json").write_text(json.dumps(settings))
    assert read_config(tmp_path / "config.json") == (RunConfig(), Digests(None, None))


def nested(**rl):
    settings = asdict(BGPOConfig())
    return {"algorithm": {**settings, "rl": {**settings["rl"], **rl}}}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"color": 1}, "unknown setting color"),
        (nested(momentum=0.9), "unknown setting algorithm.rl.momentum"),
        (nested(gamma="0.9"), "algorithm.rl: gamma must be a number, got 0.9"),
        (
            nested(hidden_sizes=[5, 0.5]),
            "algorithm.rl: hidden_sizes must be tuple[int, ...], got [5, 0.5]",
        ),
        ({"algorithm": 3}, "algorithm holds no settings"),
        ({"name": "mine", "algorithm_class": "os.path"}, "of 'mine', whose hyperparameters no im"),
    ],
)
def test_invalid_settings_are_refused(tmp_path, refused, changes, said):
    path = write(tmp_path / "config.json", RunConfig(), **changes)
    refused(lambda: read_config(path), said, str(path))


class Juggle(nico.NicoTask):
    """A task in name only."""


@pytest.mark.parametrize(
    ("modules", "where"), [(None, repr(Juggle.__module__)), ({}, "'a script or notebook'")]
)
def test_the_module_of_an_unknown_task_is_reported_not_imported(tmp_path, modules, where):
    nico.add_task("juggle", Juggle)
    config = RunConfig(tasks=("grasp_glass", "juggle"), task_starts=(0, 2))
    changes = {} if modules is None else {"task_modules": modules}
    path = write(tmp_path / "config.json", config, **changes)
    assert read_config(path)[0] == config
    nico.nico._TASKS.pop("juggle")
    said = f"has the task 'juggle', added by {where}: name the module that adds it with --import"
    with pytest.raises(ValueError, match=said):
        read_config(path)
