"""Show a trained policy one film of a demonstration, and let it act in the simulation."""

from __future__ import annotations

from bgpo_trl.data.film import read_film
from bgpo_trl.experiments.arguments import OneShotArguments
from bgpo_trl.experiments.watch import play
from bgpo_trl.policy import Recognition, load_run
from bgpo_trl.scenes import find_scene


def one_shot(arguments: OneShotArguments) -> str:
    """Show a policy a demonstration; return what it recognizes and, if asked for, achieves."""
    policy = load_run(arguments.run, seed=arguments.run_seed)
    film = read_film(arguments.demonstration)
    frames = policy.preprocess(film, color="rgb", crop=arguments.crop)
    lines = [f"{len(frames)} frames of {film.shape[1]} x {film.shape[2]}"]
    lines += _recognized(policy.condition(frames, task=arguments.task))
    if arguments.task is None:
        return "\n".join([*lines, "--task NAME plays it in the simulation"])
    find_scene(policy.config.scene).check_tasks([arguments.task])
    episode = play(policy, arguments.task, frames, arguments.scene_seed)
    return "\n".join([*lines, f"{arguments.task}: {episode.outcome}"])


def _recognized(found: Recognition) -> list[str]:
    lines = []
    if found.node is not None:
        lines.append(f"behavior: node {found.node} of GWR-B, activity {found.activity:.2f}")
    if found.group is not None:
        novel = "within the group" if found.known else "unlike what the group was shown"
        lines.append(f"group {found.group}, novelty {found.group_novelty:.2f}: {novel}")
    return lines or ["the algorithm has neither GWR-B nor groups: nothing is inferred"]
