"""Behavior-Guided Policy Optimization (Hafez & Wermter, 2021) for TorchRL."""

from typing import TYPE_CHECKING

# First, because TorchRL imports MuJoCo, which reads once what this chooses.
from suites import opengl as opengl

if TYPE_CHECKING:
    from bgpo_trl.policy import TrainedPolicy, load_run
else:

    def __getattr__(name):
        # TorchRL and MuJoCo take seconds to import: only who asks for these waits for them.
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from bgpo_trl import policy as trained_policy

        return getattr(trained_policy, name)


__all__ = ["TrainedPolicy", "load_run"]
