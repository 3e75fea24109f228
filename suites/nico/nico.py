"""Entry points of the suite: `load`, `add_task`, `register` and the lists of tasks."""

from collections.abc import Mapping, Sequence
from operator import itemgetter
from types import MappingProxyType
from typing import Any

import numpy as np
from dm_control import suite
from dm_control.utils import containers

from suites.nico.base import CONTROL_TIMESTEP, TIME_LIMIT, Environment, NicoTask, Observation
from suites.nico.physics import Physics, scene_xml
from suites.nico.rendering import FRAME_HEIGHT, FRAME_WIDTH, FrameRenderer, check_frame_size
from suites.nico.tasks import (
    GraspGlass,
    LiftGreen,
    PressWhite,
    PushGlassRight,
    PushGreenToGlass,
    PushGreenToWhite,
    PushWhiteLeft,
    PushWhiteRight,
)

_TASKS: dict[str, type[NicoTask]] = {
    "grasp_glass": GraspGlass,
    "push_green_to_glass": PushGreenToGlass,
    "push_green_to_white": PushGreenToWhite,
    "push_glass_right": PushGlassRight,
    "lift_green": LiftGreen,
    "press_white": PressWhite,
    "push_white_left": PushWhiteLeft,
    "push_white_right": PushWhiteRight,
}
PAPER_TASKS = ("grasp_glass", "push_green_to_glass", "push_green_to_white")
"""Names of the paper's tasks, in its order, the default of the experiments."""
ALL_TASKS = tuple(_TASKS)
"""Names of all tasks of the suite, the paper's first."""
TASKS: Mapping[str, type[NicoTask]] = MappingProxyType(_TASKS)
"""Classes of the suite's and of added tasks, by name."""


def add_task(name: str, task: type[NicoTask]) -> None:
    """Register a custom task under a name, for this process.

    Adding the same name again replaces the task, for example when a notebook cell runs twice.
    ``PAPER_TASKS``, the default everywhere, stays the same.

    Args:
        name: Name of the task in `load`, datasets, settings and CSV files.
        task: Class that defines the condition of success and, for recording, a demonstration.

    Raises:
        ValueError: If the name is taken by one of the suite's tasks, is "all" or not an identifier,
            or the class is not a `NicoTask`.

    Examples:
        >>> from suites import nico
        >>> class TouchWhiteWithGlass(nico.NicoTask):
        ...     def succeeded(self, physics):
        ...         return physics.touching("glass", "white_box")
        >>> nico.add_task("touch_white_with_glass", TouchWhiteWithGlass)
        >>> nico.load("touch_white_with_glass", seed=0, observation="state").step([0] * 4).reward
    """
    taken = (*ALL_TASKS, "all")
    if name in taken or not name.isidentifier():
        raise ValueError(
            f"a task cannot be called {name!r}: take letters, digits and underscores, and none of "
            f"{', '.join(taken)}"
        )
    if not (isinstance(task, type) and issubclass(task, NicoTask)):
        raise ValueError(f"{name} must be a subclass of NicoTask, got {task!r}")
    _TASKS[name] = task


def load(
    task: str,
    *,
    seed: int | np.random.RandomState | None = None,
    spread: float = 1.0,
    observation: Observation = "pixels",
    frame_size: Sequence[int] = (FRAME_HEIGHT, FRAME_WIDTH),
    time_limit: float = TIME_LIMIT,
    physics: Physics | None = None,
    renderer: FrameRenderer | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
) -> Environment:
    """Return an environment of NICO at the table.

    Args:
        task: One of `TASKS`.
        seed: Seed or random state of the start states; ``None`` for a random seed.
        spread: Share of the whole range of start states, as of `NicoTask`.
        observation: As of `NicoTask`.
        frame_size: Height and width of ``pixels``, such as ``(84, 84)``. Narrower frames also show
            the whole table.
        time_limit: Length of an episode (s); a step takes 0.2 s.
        physics: Simulation to share with other tasks that do not run at the same time.
        renderer: Renderer to share with other environments of the same frame size.
        environment_kwargs: Further arguments of ``dm_control.rl.control.Environment``.

    Raises:
        ValueError: If the task, the spread, the observation or the frame size is invalid, or
            ``time_limit`` is not positive.

    Examples:
        >>> from suites import nico
        >>> env = nico.load("grasp_glass", seed=0)
        >>> env.reset().observation["pixels"].shape
        (32, 64, 3)
    """
    if task not in TASKS:
        raise ValueError(
            f"no NICO task {task!r}; choose one of {', '.join(TASKS)}, or add it with nico.add_task"
        )
    if not time_limit > 0:
        raise ValueError(f"time_limit must be above 0 s, got {time_limit}: a step takes 0.2 s")
    physics = physics or Physics.from_xml_string(scene_xml())
    check_frame_size(physics.model.ptr, frame_size)
    return Environment(
        physics,
        TASKS[task](
            random=seed,
            spread=spread,
            observation=observation,
            frame_size=frame_size,
            renderer=renderer,
        ),
        time_limit=time_limit,
        control_timestep=CONTROL_TIMESTEP,
        **(environment_kwargs or {}),
    )


def register() -> None:
    """Register the tasks in ``dm_control.suite`` as domain ``nico``.

    Then ``suite.ALL_TASKS`` and ``TASKS_BY_DOMAIN`` list them, and TorchRL's
    ``DMControlEnv("nico", "grasp_glass")`` finds them, in this process: within workers, use
    ``DMControlWrapper(nico.load("grasp_glass"))``. Call it again after adding a task.

    Examples:
        >>> from dm_control import suite
        >>> from suites import nico
        >>> nico.register()
        >>> suite.load("nico", "grasp_glass", task_kwargs={"random": 0}).action_spec().shape
        (4,)
    """
    domain = type(suite)("nico")
    tasks = containers.TaggedTasks()
    for name in TASKS:

        def factory(
            random: int | np.random.RandomState | None = None,
            environment_kwargs: Mapping[str, Any] | None = None,
            *,
            name: str = name,
            **kwargs: Any,
        ) -> Environment:
            return load(name, seed=random, environment_kwargs=environment_kwargs, **kwargs)

        factory.__name__ = name
        tasks.add("no_reward_visualization")(factory)
    domain.SUITE = tasks  # pyright: ignore[reportAttributeAccessIssue]
    suite._DOMAINS["nico"] = domain  # `suite.load` has no public way to add a domain.
    suite.TASKS_BY_DOMAIN["nico"] = tuple(TASKS)
    ours = [("nico", name) for name in TASKS]
    for listed in ("ALL_TASKS", "EXTRA", "NO_REWARD_VIZ"):
        others = [pair for pair in getattr(suite, listed) if pair[0] != "nico"]
        setattr(suite, listed, tuple(sorted([*others, *ours], key=itemgetter(0))))
