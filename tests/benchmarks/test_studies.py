"""The studies: what they measure without a policy is what a run has."""

import pandas as pd
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch.func import functional_call

from benchmarks.studies import one_task, trained
from benchmarks.studies.cut_demonstrations import Networks, unknown_task
from benchmarks.studies.gwr_as_published import Arguments, grow
from benchmarks.studies.trained import POLICIES, FasterPolicy, Row, measure_trained, summarized
from bgpo_trl.modules.actor_critic import Actor, Critic, ProposalPolicy
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.policy import load_all_seeds
from tests.helpers import finish, spied


@pytest.mark.usefixtures("easy_world")
def test_gwr_grows_without_a_policy_as_in_a_run(begin, make_config, bank, tmp_path):
    config = make_config(name="bgpo-paper", episodes=60)
    finish(begin(tmp_path / "run", config))
    rows = pd.read_csv(tmp_path / "run" / "train.csv")
    arguments = Arguments(tmp_path, seeds=config.seeds, episodes=60, every=1)
    _, nodes = grow(bank.seen(), config.task_starts, 1.0, arguments)
    found, expected = (
        table.sort_values(["seed", "episode"])[column].tolist()
        for table, column in ((nodes, "nodes"), (rows, "num_nodes"))
    )
    assert found == expected
    assert max(found) > 3


def test_a_node_is_of_the_task_of_which_it_holds_the_largest_share(bank):
    """By hand: task 0 has four demonstrations, tasks 1 and 2 two each; node 3 holds nothing."""
    rows = torch.tensor([0, 3, 6, 9, 1, 4, 2, 5])
    networks = Networks(GWRB(32, batch_size=[1]), [BehaviorGroups(32)], bank._select(rows))
    known = torch.tensor([[0, 0, 0, 1, 1, 1, 2, 2]])  # node 1: a quarter of task 0, all of task 1
    node = torch.tensor([[0, 0, 1, 1, 2, 3]])
    task = torch.tensor([0, 1, 1, 0, 2, 0])
    right = networks.right(node, known, task)
    assert right.tolist() == [[True, False, True, False, True, False]]


def test_an_unknown_task_is_told_by_its_novelty(bank):
    known = bank.for_tasks(bank.tasks[:2])
    networks = Networks.grow(known.seen(), (3, 8), 60)
    far = bank.of_task(2).embedding + 10
    found = unknown_task(networks, known.seen().embedding, far, (3, 8))
    assert found["area"].tolist() == [1, 1]
    assert found["detected"].tolist() == [1, 1]
    same = unknown_task(networks, known.seen().embedding, known.seen().embedding, (3, 8))
    assert same["area"].tolist() == [0.5, 0.5]


def test_before_training_a_clone_is_tested_by_what_it_has_imitated(monkeypatch):
    monkeypatch.setattr(one_task, "N_IMITATION", 3)
    trial = one_task.Trial(one_task.Arguments(demonstrations=5, tests=1))
    trial.imitate()
    acted = spied(trial, "act")
    trial.report(0, alone=True)
    (latent, *_), action = acted[0]
    state = TensorDict({"latent": latent[None, None]}, [1, 1, 1])
    imitated = trial.learner.loss.call_network("clone_network", state)["action"]
    torch.testing.assert_close(action, imitated[0, 0])


def test_a_policy_of_proposals_is_taken_apart():
    torch.manual_seed(0)
    actor, clone = Actor(6, in_keys=["latent"]), Actor(6, in_keys=["latent"])
    policy = ProposalPolicy(actor, clone, Critic(6, in_keys=["latent"], batch_size=[5]))
    weights = {**dict(policy.named_parameters()), **dict(policy.named_buffers())}
    states = TensorDict({"latent": torch.randn(50, 6)}, [50])
    found = {
        name: functional_call(policy, change(weights), (states.copy(),))["action"]
        for name, change in POLICIES.items()
    }
    torch.testing.assert_close(found["actor alone"], actor(states.copy())["action"])
    torch.testing.assert_close(found["clone alone"], clone(states.copy())["action"])
    of_actor = (found["critics choose"] == found["actor alone"]).all(-1)
    of_clone = (found["critics choose"] == found["clone alone"]).all(-1)
    assert (of_actor ^ of_clone).all()
    assert of_actor.any() and of_clone.any()
    only = {**weights, "only_clone": torch.tensor(True)}
    as_tested = functional_call(policy, POLICIES["as in tests"](only), (states.copy(),))["action"]
    assert as_tested.equal(found["clone alone"])


@pytest.mark.usefixtures("easy_world")
def test_a_faster_clone_multiplies_the_clones_actions(begin, tmp_path):
    begin(tmp_path / "run").run()
    run = load_all_seeds(tmp_path / "run")
    rows = measure_trained(run, 3, speeds=(1.0, -50.0))
    found = {name: [r[1:] for r in rows if r.policy == name] for name in {r.policy for r in rows}}
    assert [*dict.fromkeys(r.policy for r in rows)] == [
        *POLICIES,
        "clone alone x 1",
        "clone alone x -50",
    ]
    assert found["clone alone x 1"] == found["clone alone"]
    assert found["clone alone x -50"] != found["clone alone"]
    fixed = TensorDictModule(lambda state: torch.tensor([0.5, -0.25]), ["state"], ["action"])
    policy = FasterPolicy(fixed, "state", {}, speed=3.0)
    assert policy.act(torch.zeros(3)).tolist() == [1.0, -0.75]


def test_what_a_policy_has_above_its_clone_is_paired_by_seed():
    """By hand: differences of .2 and .1, so .15 +- .64 with one degree of freedom."""
    success = {"as in tests": (0.9, 0.5), "clone alone": (0.7, 0.4)}
    rows = [
        Row(policy, seed, "push", 10, of_seeds[seed], 12.0 + seed)
        for policy, of_seeds in success.items()
        for seed in (0, 1)
    ]
    cells = [line.strip("| ").split(" | ") for line in summarized(pd.DataFrame(rows)).splitlines()]
    assert cells[0] == ["task", "as in tests", "clone alone", "above clone"]
    assert cells[2] == ["push", "70.0 % in 12.5", "55.0 % in 12.5", "+15.0 [-49, +79]"]
    alone = summarized(pd.DataFrame(rows[:2])).splitlines()
    assert alone[0].strip("| ").split(" | ") == ["task", "as in tests"]


@pytest.mark.usefixtures("easy_world")
def test_the_latest_weights_are_tested_if_asked_for(begin, tmp_path, monkeypatch):
    begin(tmp_path / "run").run()
    found, expected = [], []

    def measure(run, episodes, watch, *, speeds):
        assert speeds == ()
        learner = run.algorithm.learner
        place = torch.zeros((), dtype=torch.int64)
        for averaged, weights in ((False, expected), (True, found)):
            weights.append(learner.policy_weights(place, place, averaged=averaged))
        assert run.algorithm.actor_weights(0).keys() == found[-1].keys()
        return [Row("as in tests", 3, "grasp_glass", episodes, 1.0, 5.0)]

    monkeypatch.setattr(trained, "measure_trained", measure)
    for latest in (False, True):
        trained.trained(trained.WeightsArguments(run=tmp_path / "run", latest=latest))
    same = [all(a[key].equal(b[key]) for key in a) for a, b in zip(found, expected, strict=True)]
    assert same == [False, True]
