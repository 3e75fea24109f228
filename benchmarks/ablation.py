"""The paper's third experiment (Fig. 9), BGPO without some of its parts: `bgpo ablation`."""

from __future__ import annotations

from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.experiments.paper import ablation

if __name__ == "__main__":
    command_line(ablation)
