"""NICO at a table: a dm_control suite of sparse-reward visuomotor tasks."""

# First, since importing it chooses the OpenGL backend, which must precede MuJoCo's import.
from suites.nico import rendering  # isort: skip
from suites.nico.base import NicoTask, nominal_places, scene_version
from suites.nico.nico import ALL_TASKS, PAPER_TASKS, TASKS, add_task, load, register
from suites.nico.physics import OBJECTS, Physics, scene_xml

__all__ = [
    "ALL_TASKS",
    "OBJECTS",
    "PAPER_TASKS",
    "TASKS",
    "NicoTask",
    "Physics",
    "add_task",
    "load",
    "nominal_places",
    "register",
    "rendering",
    "scene_version",
    "scene_xml",
]
