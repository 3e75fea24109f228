"""The graphs that a run keeps of its GWR-B."""

import pytest
import torch

from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.runs.gwr_graphs import growth_moments, load_graphs, save_graph
from tests.helpers import largest_file, rows


def grown(seed=0, n=30):
    generator = torch.Generator().manual_seed(seed)
    gwr = GWRB(3, batch_size=[2], generator=[generator] * 2)
    for _ in range(n):
        gwr.adapt(torch.rand(2, 3, generator=generator))
    return gwr


def test_growth_moments_are_evenly_spaced():
    assert growth_moments(1) == [1] and growth_moments(10) == [2, 4, 5, 7, 9, 10]


def test_loaded_graphs_equal_the_saved_ones(tmp_path):
    early, late = grown(n=5), grown(n=30)
    save_graph(tmp_path, 30, late)
    save_graph(tmp_path, 5, early)
    graphs = load_graphs(tmp_path)
    assert list(graphs) == [5, 30]
    for gwr, loaded in zip((early, late), graphs.values(), strict=True):
        for first, second in zip(gwr.graph(0), loaded.graph(), strict=True):
            assert first.equal(second)
        assert loaded.get_extra_state()[0]["next_node"] == gwr.get_extra_state()[0]["next_node"]


def test_run_saves_the_graphs_of_its_first_seed(tmp_path, begin, make_config):
    with begin(tmp_path, make_config(episodes=8)) as trainer:
        trainer.run()
    graphs = load_graphs(tmp_path / "gwr")
    assert list(graphs) == growth_moments(8)
    train = rows(tmp_path / "train.csv")
    logged = {int(row["episode"]): row["num_nodes"] for row in train if row["seed"] == "3"}
    found = {episode: str(int(gwr.num_nodes)) for episode, gwr in graphs.items()}
    assert found == {episode: logged[episode] for episode in graphs}
    last = graphs[8].graph()
    # All episodes have 6 steps, so both seeds end with their eighth.
    for first, second in zip(last, trainer.algorithm.gwr.graph(0), strict=True):
        assert first.equal(second)
    assert not last.weights.equal(trainer.algorithm.gwr.graph(1).weights)


def test_a_full_disk_leaves_the_earlier_graph_and_a_damaged_one_is_refused(tmp_path):
    path = save_graph(tmp_path, 5, grown(n=5))
    before = path.read_bytes()
    with largest_file(100), pytest.raises(OSError, match=r"cannot write .*: make room, or choose"):
        save_graph(tmp_path, 5, grown(n=30))
    assert [*tmp_path.iterdir()] == [path]
    assert path.read_bytes() == before
    for content in (b"", before[:-9]):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"episode-000005.safetensors is damaged or not a"):
            load_graphs(tmp_path)
