"""Behavior-Guided Policy Optimization (Hafez & Wermter, 2021) for TorchRL."""

from typing import TYPE_CHECKING

try:
    # First, because TorchRL imports MuJoCo, which reads once what this chooses.
    from suites import opengl as opengl
except ImportError as error:
    if error.path is None:
        raise
    raise ImportError(
        f"{error}: another package `suites` hides ours: remove its __init__.py, or start elsewhere"
    ) from None

if TYPE_CHECKING:
    from bgpo_trl.policy import TrainedPolicy, load_run

    __version__: str
else:

    def __getattr__(name):
        if name == "__version__":
            from importlib.metadata import version

            return version("bgpo_trl")
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        # TorchRL and MuJoCo take seconds to import: only users of these wait for them.
        from bgpo_trl import policy

        return getattr(policy, name)

    def __dir__():
        return sorted({*globals(), *__all__})


__all__ = ["TrainedPolicy", "__version__", "load_run"]
