"""Groups of behaviors: which group an input belongs to as demonstrations are shown."""

import pytest
import torch

from bgpo_trl.modules.behavior_groups import BehaviorGroups

PLACES = 12.0 * torch.eye(4)


def around(place, count, seed=0):
    """Demonstrations of unit variance around one of four places, ``[count, 4]``."""
    generator = torch.Generator().manual_seed(100 * place + seed)
    return PLACES[place] + torch.randn(count, 4, generator=generator)


def show(groups, demonstrations):
    """Shows them one by one; returns the group of each from before."""
    return [int(groups.adapt(phi).group) for phi in demonstrations]


def group_of(groups, demonstrations):
    return groups.lookup(demonstrations).group.unique().tolist()


def test_inputs_are_unknown_and_of_group_0_before_the_first_clustering():
    groups = BehaviorGroups(4)
    match = groups.lookup(torch.rand(3, 5, 4))
    assert match.group.equal(torch.zeros(3, 5, dtype=torch.int64))
    assert not match.known.any()
    assert groups.numbers == [0]
    one, few = BehaviorGroups(4), around(0, 9)
    show(one, few.repeat(10, 1))  # again and again adds nothing
    assert not one.lookup(few).known.any()
    show(one, around(0, 1, seed=1))
    assert one.lookup(few).known.all()
    assert (one.numbers, one.revision) == ([0], 0)


def test_new_behavior_gets_its_group_within_thirty_demonstrations():
    groups = BehaviorGroups(4)
    assert set(show(groups, around(0, 60))) == {0}
    played = show(groups, around(1, 30))
    assert played[0] == 0 and played[-1] == 1
    assert played == sorted(played)
    assert groups.numbers == [0, 1]
    assert groups.parent[1] == 0
    before = groups.state_dict()
    for place in (0, 1):
        assert group_of(groups, around(place, 50, seed=1)) == [place]
    torch.testing.assert_close(groups.state_dict(), before, rtol=0, atol=0)


def test_novelty_is_relative_to_the_extent_of_the_group():
    groups = BehaviorGroups(4)
    wide = 4 * (around(1, 100) - PLACES[1])
    show(groups, torch.cat([around(0, 100), wide - 60]))
    assert len(groups.numbers) == 2
    ours = around(0, 400, seed=1)
    assert 0.9 < float(groups.lookup(ours).known.float().mean()) < 1.0
    # Seven deviations from the first group are far, from the second they are not.
    off = torch.tensor([7.0, 0, 0, 0])
    assert not groups.lookup(PLACES[0] + off).known
    assert groups.lookup(off - 60).known
    along = groups.lookup(PLACES[0] + torch.arange(2, 20).unsqueeze(-1) * off).novelty
    assert (along.diff() > 0).all()


@pytest.mark.parametrize("sizes", [(45, 75), (75, 45)])
def test_larger_part_of_a_split_group_keeps_the_number(sizes):
    inputs = torch.cat([around(place, size) for place, size in enumerate(sizes)])
    order = torch.randperm(120, generator=torch.Generator().manual_seed(0))
    groups = BehaviorGroups(4, smallest=40)
    assert set(show(groups, inputs[order])) == {0}  # until it splits with the last of them
    assert groups.numbers == [0, 1]
    assert groups.parent[1] == 0
    larger = sizes.index(75)
    assert group_of(groups, around(larger, 9, seed=2)) == [0]
    assert group_of(groups, around(1 - larger, 9, seed=2)) == [1]


@pytest.mark.parametrize("often", [0, 1])
def test_merged_groups_keep_the_number_of_the_one_shown_most(often):
    """Two clusters, until demonstrations fill the valley between them."""
    rng = torch.Generator().manual_seed(3)

    def line(low, high, count):
        return torch.rand(count, 1, generator=rng) * (high - low) + low

    parts = line(0, 4, 50), line(8, 12, 50)
    groups = BehaviorGroups(1)
    show(groups, torch.cat(parts))
    assert len(groups.numbers) == 2
    numbers = [group_of(groups, part)[0] for part in parts]
    assert sorted(numbers) == [0, 1]
    show(groups, parts[often].repeat(3, 1))
    assert groups.revision == 1
    show(groups, line(4, 8, 60))
    assert len(groups.numbers) == 1
    assert groups.numbers == [numbers[often]]
    assert group_of(groups, torch.linspace(0, 12, 50).unsqueeze(-1)) == [numbers[often]]
    assert groups.revision > 1
    # Numbers are never used again: the next new group is 2, though only one is left.
    show(groups, line(40, 44, 40))
    assert groups.numbers == sorted([numbers[often], 2])
    assert groups.parent[2] == numbers[often]


def test_behaviors_that_differ_in_a_small_feature_have_their_groups():
    """All vary in four wide features, so that plain distances know one group."""
    generator = torch.Generator().manual_seed(0)
    which = torch.arange(400) % 2
    inputs = torch.randn(400, 5, generator=generator) * torch.tensor([1.0, 1.0, 1.0, 1.0, 0.14])
    inputs[:, 4] += 1.4 * which
    groups = BehaviorGroups(5)
    show(groups, inputs[:300])
    found = groups.lookup(inputs[300:])
    assert len(groups.numbers) == 2
    assert len({*zip(which[300:].tolist(), found.group.tolist(), strict=True)}) == 2


@pytest.mark.parametrize(
    "phi", [torch.zeros(5), torch.full((4,), torch.nan), torch.zeros(2, 5)], ids=str
)
def test_bad_inputs_are_rejected_and_change_nothing(phi):
    groups = BehaviorGroups(4)
    for call in (groups.lookup, groups.adapt):
        with pytest.raises(ValueError, match="phi must"):
            call(phi)
    with pytest.raises(ValueError, match="phi must"):
        groups.adapt(torch.zeros(2, 4))
    for start, shown in (
        ([0, torch.nan], r"\[0.0, nan\]"),
        (1.0, "1.0"),
        ([[1.0]], r"\[\[1.0\]\]"),
    ):
        with pytest.raises(ValueError, match=f"start must be .* finite numbers, got {shown}"):
            groups.adapt(torch.zeros(4), torch.tensor(start))
    assert len(groups.points) == 0
    for options in ({"smallest": 3}, {"smallest": 4.5}, {"evidence": 0}):
        with pytest.raises(ValueError, match="smallest must be"):
            BehaviorGroups(2, **options)


def test_inputs_may_be_lists_and_arrays():
    of_lists, of_tensors = BehaviorGroups(4), BehaviorGroups(4)
    for phi in around(0, 25):
        of_lists.adapt(phi.tolist(), [1.0, 2.0])
        of_tensors.adapt(phi, torch.tensor([1.0, 2.0]))
    found, expected = of_lists.state_dict(), of_tensors.state_dict()
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
    array = around(0, 3).numpy()
    assert of_lists.lookup(array).group.equal(of_lists.lookup(torch.from_numpy(array)).group)


def test_damaged_states_and_those_of_other_sizes_are_rejected_and_change_nothing():
    groups = BehaviorGroups(4)
    show(groups, around(0, 12))
    before = groups.state_dict()
    for bad in (
        BehaviorGroups(3).state_dict(),
        {**before, "group": before["group"] + 1},
        {**before, "member": before["member"][1:]},
        {**before, "points": before["points"] * torch.nan},
        {**before, "cluster": before["cluster"].repeat(2)},
        {**before, "latest": 12},
        {},
    ):
        with pytest.raises(ValueError, match="state"):
            groups.load_state_dict(bad)
    torch.testing.assert_close(groups.state_dict(), before, rtol=0, atol=0)


def test_a_success_after_a_load_is_that_of_the_demonstration_shown_last():
    groups = BehaviorGroups(4)
    show(groups, around(0, 5))
    loaded = BehaviorGroups(4)
    loaded.load_state_dict(groups.state_dict())
    loaded.end(0, 0, fits=True, success=True)
    assert loaded.tried.tolist() == loaded.won.tolist() == [0, 0, 0, 0, 1]


def test_joined_groups_stay_joined_when_clustered_anew():
    joined, plain = BehaviorGroups(4), BehaviorGroups(4)
    shown = torch.cat([around(0, 60), around(1, 60), around(2, 70)])
    assert show(joined, shown) == show(plain, shown)
    assert joined.numbers == [0, 1, 2]
    for pair in ((0, 0), (0, 5), (-1, 0)):
        with pytest.raises(ValueError, match="groups to join must be"):
            joined.join(*pair)
    joined.join(0, 2)
    assert joined.revision == plain.revision + 1
    assert joined.numbers == [1, 2]  # 2 was shown more often than 0
    for seed in (1, 2):  # clustered anew, soon with a fourth group
        for place, expected in enumerate((2, 1, 2)):
            assert group_of(joined, around(place, 9, seed)) == [expected]
            assert group_of(plain, around(place, 9, seed)) == [place]
        for groups in (joined, plain):
            show(groups, torch.cat([around(place, 25, seed) for place in (2, 0, 3)]))
    restored = BehaviorGroups(4)
    restored.load_state_dict(joined.state_dict())
    for groups, n_groups in ((joined, 3), (restored, 3), (plain, 4)):
        show(groups, around(1, 20, seed=9))
        assert len(groups.numbers) == n_groups


@pytest.mark.parametrize(("n_known", "group"), [(25, 0), (15, 2)])
def test_a_cluster_is_of_a_joined_group_that_solves_it_if_most_of_it_was(n_known, group):
    groups = BehaviorGroups(4)
    show(groups, torch.cat([around(place, 40) for place in (0, 1, 2)]))
    groups.join(0, 1)
    assert groups.numbers == [0, 2]
    state = groups.state_dict()
    state["tried"][:] = state["won"][:] = 1
    state["group"][80 : 80 + n_known] = 0
    groups.load_state_dict(state)
    show(groups, around(2, 40, seed=1))  # clustered anew
    assert group_of(groups, around(2, 50, seed=2)) == [group]


@pytest.mark.parametrize(
    ("every", "played", "n_groups"),
    [(2, 1_000, 1), (8, 1_000, 2), (2, 8, 1), (2, 6, 2)],  # 8: four successes
)
def test_a_part_of_a_joined_group_parts_unless_the_groups_expert_solves_it(every, played, n_groups):
    """The first of two joined groups falls into halves in time, like a new task beside an old."""
    generator = torch.Generator().manual_seed(0)

    def draw(count, place=0.0, halves=0.0):
        inputs = place + torch.randn(count, 1, generator=generator)
        inputs[1::2] += halves
        return inputs

    groups, plain = BehaviorGroups(1), BehaviorGroups(1)

    n_upper = 0  # episodes of the upper half, of which the group's expert plays the first

    def play(inputs):
        """All of the group is solved every other time, the upper half perhaps less often."""
        nonlocal n_upper
        for number, phi in enumerate(inputs):
            group = int(groups.adapt(phi).group)
            plain.adapt(phi)
            upper = 2.25 < float(phi) < 20
            n_upper += upper
            if upper and n_upper > played:
                continue
            success = n_upper % every == 0 if upper else number % 4 < 2
            groups.end(group, group, fits=True, success=success)

    play(torch.cat([draw(60, halves=4.5), draw(40, place=40.0)]))
    assert groups.numbers == plain.numbers == [0, 1]
    groups.join(0, 1)
    play(draw(200, halves=4.5))
    assert len(plain.numbers) == 3
    assert len(groups.numbers) == n_groups
    restored = BehaviorGroups(1)
    restored.load_state_dict(groups.state_dict())
    for each in (groups, restored):
        show(each, draw(40, place=-40.0))  # of what nobody has solved
        assert len(each.numbers) == n_groups + 1


def test_vectors_embedded_twice_are_one_demonstration_whatever_their_rounding():
    """In another batch, the last digits of an embedding are others."""
    once, twice = BehaviorGroups(4), BehaviorGroups(4)
    points = torch.cat([around(0, 40), around(1, 40, seed=1)])
    show(once, points)
    noise = torch.Generator().manual_seed(0)
    for point in points:
        twice.adapt(point)
        twice.adapt(point + 1e-6 * point.norm() * torch.randn(4, generator=noise))
    assert len(twice.numbers) == len(once.numbers) == 2
    assert twice.state_dict()["shown"].tolist() == [2] * len(points)
