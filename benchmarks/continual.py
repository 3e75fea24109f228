"""The paper's second experiment (Fig. 8), one task after the other: `bgpo continual`."""

from __future__ import annotations

from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.experiments.run import continual

if __name__ == "__main__":
    command_line(continual)
