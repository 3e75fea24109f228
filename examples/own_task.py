"""A custom task, from its success test to its learning curve: python examples/own_task.py.

A second call resumes the run. To see learning rather than its start, raise ``episodes``.
"""

from pathlib import Path

from bgpo_trl.analysis.task_inference import task_inference_accuracy
from bgpo_trl.configs import RunConfig
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.encoders.train import make_bank
from bgpo_trl.figures.style import save_figure
from bgpo_trl.figures.success import plot_success_curves
from bgpo_trl.runs.results import read_run
from bgpo_trl.training import Trainer
from suites import nico
from suites.nico import moves

OWN, OUT = "push_white_to_green", Path("runs/own-task")


class PushWhiteToGreen(nico.NicoTask):
    """Success: the white box touches the green box for two steps."""

    steady_steps = 2

    def succeeded(self, physics):
        return physics.touching("white_box", "green_box")

    def demonstration(self, physics, random):
        return moves.push(physics, random, "white_box", "green_box")


if __name__ == "__main__":
    nico.add_task(OWN, PushWhiteToGreen)
    folder = OUT / "demonstrations"
    shown = record_demonstrations(folder, tasks=[OWN], per_task=12, held_out_per_task=4)
    encoders, bank = load_pretrained()
    bank += make_bank(encoders, shown, tasks=[OWN])
    print(f"{len(shown)} demonstrations, {shown['length'].float().mean():.0f} frames each")

    tasks, starts = (OWN, *nico.PAPER_TASKS), (0, 2, 4, 6)
    config = RunConfig(seeds=(0,), episodes=8, tasks=tasks, task_starts=starts, eval_every=4)
    with Trainer(config, OUT / "run", bank=bank, encoders=encoders, resume=True) as trainer:
        trainer.run()
    run = read_run(OUT / "run")
    save_figure(plot_success_curves({"BGPO": run}), OUT / "success.png")
    for task in tasks:
        won, passed = (t.loc[t["task"] == task, "success"] for t in (run.training, run.tests))
        counts = f"{won.sum():.0f} of {len(won)} in training, {passed.sum():.0f} of {len(passed)}"
        print(f"{task}: {counts} tests")
    gwr = trainer.algorithm.gwr
    inferred = task_inference_accuracy(gwr, bank.seen(), bank.held_out())
    print(f"GWR-B, {gwr.num_nodes.item()} nodes: task inferred for {inferred.item():.0%}, held out")
