"""Settings read back from config.json."""

import json
from dataclasses import asdict, dataclass, field, replace

import pytest

from bgpo_trl.algorithms import ABLATIONS, ALGORITHMS
from bgpo_trl.algorithms.rl import RL
from bgpo_trl.configs import PRESETS, BGPOConfig, DDPGConfig, GWRBConfig, RunConfig
from bgpo_trl.runs.config_file import Digests, read_config, settings_of
from suites import nico


def write(path, config, **changes):
    path.write_text(json.dumps({**settings_of(config, Digests("abc", "def")), **changes}))
    return path


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", ALGORITHMS)
def test_what_was_written_is_read(tmp_path, preset, name):
    algorithm = replace(
        ALGORITHMS[name].config, state="state", rl=DDPGConfig(hidden_sizes=(5, 7), gamma=0.5)
    )
    config = replace(PRESETS[preset], name=name, algorithm=algorithm, checkpoint_minutes=3)
    read, digests = read_config(write(tmp_path / "config.json", config))
    assert (read, digests) == (config, Digests(encoders="abc", bank="def"))
    assert type(read.algorithm) is type(algorithm)
    assert isinstance(read.algorithm.rl.hidden_sizes, tuple)


@pytest.mark.parametrize("name", RL)
def test_an_rl_algorithm_is_known_by_its_name(tmp_path, name):
    rl = replace(RL[name].config, gamma=0.5)
    config = RunConfig(algorithm=BGPOConfig(rl=rl))
    read, _ = read_config(write(tmp_path / "config.json", config))
    assert read == config
    assert type(read.algorithm.rl) is type(rl)


@pytest.mark.parametrize("name", ABLATIONS)
def test_ablations_are_read(tmp_path, name):
    config = RunConfig(name=name, algorithm=replace(ALGORITHMS[name].config, beta=0.3))
    path = write(tmp_path / "config.json", config, encoders=None)
    assert read_config(path) == (config, (None, "def"))


@dataclass(frozen=True)
class CoarseConfig(BGPOConfig):
    coarse: GWRBConfig | None = None


@pytest.mark.parametrize("coarse", [None, GWRBConfig(activity_threshold=0.777)])
def test_a_setting_that_may_be_absent_is_read(tmp_path, coarse):
    config = RunConfig(name="mine", algorithm=CoarseConfig(coarse=coarse))
    path = write(tmp_path / "config.json", config)
    assert read_config(path)[0].algorithm.coarse == coarse
    path.write_text(path.read_text().replace("null", "7").replace("0.777", '"high"'))
    with pytest.raises(ValueError, match=r"algorithm\.coarse"):
        read_config(path)


@dataclass(frozen=True)
class OwnConfig(BGPOConfig):
    curiosity: float = 0.5


def test_hyperparameters_of_an_unknown_algorithm_are_of_the_class_that_is_stored(tmp_path):
    config = RunConfig(name="mine", algorithm=OwnConfig(curiosity=2.0))
    read, _ = read_config(write(tmp_path / "config.json", config))
    assert read == config
    assert type(read.algorithm) is OwnConfig


@dataclass(frozen=True)
class ListConfig(BGPOConfig):
    widths: list[int] = field(default_factory=lambda: [1, 2])


@dataclass(frozen=True)
class MixedConfig(BGPOConfig):
    rate: int | float = 0.5


@pytest.mark.parametrize(
    ("algorithm", "said"),
    [(ListConfig(), r"algorithm.widths is \[1, 2\]"), (MixedConfig(), "algorithm.rate is 0.5")],
)
def test_what_could_not_be_read_back_is_not_written(algorithm, said):
    with pytest.raises(ValueError, match=rf"^config.json cannot hold the setting {said}: annotate"):
        settings_of(RunConfig(algorithm=algorithm), Digests("abc", "def"))


def test_what_an_earlier_version_did_not_know_has_its_default(tmp_path):
    settings = asdict(RunConfig())
    del settings["checkpoint_minutes"], settings["algorithm"]["rl"]["critic_layer_norm"]
    (tmp_path / "config.json").write_text(json.dumps(settings))
    assert read_config(tmp_path / "config.json") == (RunConfig(), (None, None))


def nested(**rl):
    settings = asdict(BGPOConfig())
    return {"algorithm": {**settings, "rl": {**settings["rl"], **rl}}}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"color": 1}, "unknown setting color"),
        (nested(momentum=0.9), r"unknown setting algorithm.rl.momentum"),
        (nested(gamma="0.9"), r"algorithm.rl.gamma is '0.9'"),
        (nested(clip_targets=1), "algorithm.rl.clip_targets is 1"),
        (nested(hidden_sizes=[5, 0.5]), "algorithm.rl.hidden_sizes is 0.5"),
        ({"algorithm": {"state": "smell"}}, "algorithm.state is 'smell'"),
        ({"algorithm": {"rl": 3}}, "algorithm.rl is 3"),
        (nested(name="ppo"), "algorithm.rl.name is 'ppo', not a known RL algorithm"),
        ({"algorithm": 3}, "no settings of a run"),
        ({"seeds": 3}, "seeds is 3"),
        ({"seeds": []}, "seeds must be one or more"),
        ({"encoders": 3}, "encoders is 3"),
        ({"bank": 3}, "bank is 3"),
        ({"name": "mine", "algorithm_class": None}, "of 'mine', whose hyperparameters no im"),
        ({"name": "mine", "algorithm_class": "os.path"}, "of 'mine', whose hyperparameters no im"),
    ],
)
def test_what_is_no_run_of_this_version_is_refused(tmp_path, changes, said):
    path = write(tmp_path / "config.json", RunConfig(), **changes)
    with pytest.raises(ValueError, match=said) as error:
        read_config(path)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


class Juggle(nico.NicoTask):
    """A task in name only."""


@pytest.mark.parametrize(
    ("modules", "where"),
    [
        (None, f"the module {Juggle.__module__!r}"),
        ({"juggle": "__main__"}, "a script or notebook"),
        ({}, "a script or notebook"),
        ({"juggle": 3}, "a script or notebook"),
        ([], "a script or notebook"),
    ],
)
def test_the_module_of_a_task_is_named_but_not_imported(tmp_path, modules, where):
    nico.add_task("juggle", Juggle)
    config = RunConfig(tasks=("grasp_glass", "juggle"), task_starts=(0, 2))
    changes = {} if modules is None else {"task_modules": modules}
    path = write(tmp_path / "config.json", config, **changes)
    assert read_config(path)[0] == config
    nico.nico._TASKS.pop("juggle")
    said = f"has the task 'juggle', added by {where}: name a module that adds it with --import"
    with pytest.raises(ValueError, match=said):
        read_config(path)


@pytest.mark.parametrize("text", ["", "[]", '{"seeds":', "\x00", "null"])
def test_what_is_not_json_of_settings_is_refused(tmp_path, text):
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ValueError, match=r"config.json cannot be read \(.*\): use the version"):
        read_config(tmp_path / "config.json")
