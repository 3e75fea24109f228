"""The paper's third experiment: BGPO without GWR-B, without the intrinsic reward, without both.

Further variants add even replay, experts and demonstrations.

    python benchmarks/ablation.py --variant r_int --preset quick

The paper's variants (Fig. 9) differ by transforms alone, see `bgpo_trl.algorithms.environments`.
All tasks are presented from the start, with ``--continual`` one after the other.
"""

from __future__ import annotations

from bgpo_trl.experiments.arguments import command_line
from bgpo_trl.experiments.paper import AblationArguments as Arguments
from bgpo_trl.experiments.paper import ablation


def main(arguments: Arguments) -> None:
    """Run the experiment and print its results."""
    print(ablation(arguments))


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
