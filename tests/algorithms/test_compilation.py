"""Updates that are compiled."""

from dataclasses import replace

import pytest
import torch

from bgpo_trl.algorithms.ewc import EWCLearner
from bgpo_trl.algorithms.rl import LearnerSpec, make_ddpg, make_learner
from bgpo_trl.configs import DDPGConfig
from tests.algorithms.playing import make_batch, play

CPU = torch.device("cpu")


def make(experts=(0, 1), **changes):
    config = DDPGConfig(hidden_sizes=(16, 8), **changes)
    spec = LearnerSpec((3, 8), ["state", "label"], 8, (0.0, 1.3), CPU, experts)
    return make_learner(config, spec)


def batch_of(experts, seed):
    batch = make_batch(2, experts, 12, seed=seed)
    batch["demonstrated"] = torch.arange(12).expand(2, experts, 12) % 3 > 0
    return batch


def assert_same(learner, other, **tolerance):
    other = dict(other.loss.state_dict())
    for key, value in learner.loss.state_dict().items():
        torch.testing.assert_close(value, other[key], **tolerance)


@pytest.fixture
def without_compiler(monkeypatch):
    """What torch.compile returns fails when it is called, as it does without a C++ compiler."""

    def compile(graph, **_):
        def call(*_):
            raise RuntimeError("no compiler\nand where it was looked for")

        return call

    monkeypatch.setattr(torch, "compile", compile)


@pytest.mark.filterwarnings("error:updates are traced")  # it must be compiled
@pytest.mark.slow  # compiling takes 30 s where nothing is cached
def test_one_update_compiled_is_the_same_to_1e_5():
    plain, compiled = make(), make(compile=True)
    told = [learner.learn(batch_of(2, 0)) for learner in (plain, compiled)]
    torch.testing.assert_close(*told, rtol=1e-5, atol=1e-5)
    assert_same(plain, compiled, rtol=0, atol=1e-5)
    for _ in range(3):  # the compiled function has seen the changes of parameters and targets
        told = [learner.learn(batch_of(2, 1)) for learner in (plain, compiled)]
        torch.testing.assert_close(*told, rtol=1e-3, atol=1e-4)


@pytest.mark.filterwarnings("ignore:updates are traced")
def test_the_traced_losses_are_the_losses_bit_by_bit(without_compiler, monkeypatch):
    """With other numbers of experts, with weights restored, and with the former shape again."""
    plain, traced, evaluated = make(), make(compile=True), []
    loss = traced.loss.loss_actor
    monkeypatch.setattr(
        traced.loss, "loss_actor", lambda batch: evaluated.append(batch.shape[1]) or loss(batch)
    )
    for update, experts in enumerate((2, 2, 3, 3, 2, 1, 2)):
        for learner in (plain, traced):
            learner.resize(experts)
        told = [learner.learn(batch_of(experts, update)) for learner in (plain, traced)]
        torch.testing.assert_close(*told, rtol=0, atol=0)
        assert_same(plain, traced, rtol=0, atol=0)
        if update == 3:
            for learner in (plain, traced):
                learner.load_state_dict(make((0, 1, 2), learning_rate=0.1).state_dict())
    assert evaluated == [2, 3, 1]  # once for each shape


@pytest.mark.filterwarnings("ignore:updates are traced")
@pytest.mark.parametrize("name", ["maml", "dist-nll"])
def test_what_is_over_ddpg_is_traced_too(
    name, easy_world, without_compiler, make_task_algorithm, make_config
):
    """MAML has second derivatives, and its loss writes the adapted policies."""
    rl, learned = make_config("state", name).algorithm.rl, []
    for compiles in (False, True):
        algorithm = make_task_algorithm(name, rl=replace(rl, compile=compiles))
        play(algorithm, 40)
        learned.append(algorithm.learner.state_dict()["loss"])
    plain, traced = learned
    for key, value in plain.items():
        if isinstance(value, torch.Tensor):
            assert traced[key].equal(value), key


@pytest.mark.filterwarnings("ignore:updates are traced")
def test_the_traced_penalty_of_ewc_follows_its_anchors(without_compiler):
    learners = []
    for compiles in (False, True):
        config = DDPGConfig(hidden_sizes=(16,), compile=compiles)
        ddpg = make_ddpg(config, LearnerSpec((3, 8), ["state"], 6, (0.0, 1.0), CPU))
        learners.append(EWCLearner(ddpg.actor, ddpg.loss, config, weight=1e3))
    for update in range(8):
        told = [learner.learn(make_batch(2, 1, 16, seed=update)) for learner in learners]
        torch.testing.assert_close(*told, rtol=0, atol=0)
        assert told[0]["loss_ewc"].bool().tolist() == [update in (4, 5, 7), False]
        if update in (2, 5):
            for learner in learners:
                learner.consolidate(0, make_batch(30, seed=update).select("state"))
    assert_same(*learners, rtol=0, atol=0)


def test_without_a_compiler_there_is_one_line(without_compiler):
    with pytest.warns(UserWarning, match="^updates are traced, but not compiled: no compiler$"):
        make(compile=True).learn(batch_of(2, 0))


@pytest.mark.filterwarnings("ignore:updates are traced")
def test_an_error_of_the_loss_stays_one(without_compiler):
    with pytest.raises(ValueError, match="the batch lacks"):
        make(compile=True).learn(batch_of(2, 0).exclude(("next", "terminated")))
