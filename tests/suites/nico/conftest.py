from collections.abc import Callable

import pytest

from suites import nico
from suites.nico.base import Environment
from suites.nico.rendering import FrameRenderer


@pytest.fixture(scope="session")
def physics() -> nico.Physics:
    """A simulation for tests that set all of its state themselves."""
    return nico.Physics.from_xml_string(nico.scene_xml())


@pytest.fixture(scope="session")
def renderer(physics: nico.Physics) -> FrameRenderer:
    """One OpenGL context for all tests, since making it costs more than most tests."""
    return FrameRenderer(physics.model.ptr)


@pytest.fixture
def load(physics: nico.Physics, renderer: FrameRenderer) -> Callable[..., Environment]:
    """Load environments that share a simulation, to be used one at a time."""
    return lambda task, **kwargs: nico.load(task, physics=physics, renderer=renderer, **kwargs)
