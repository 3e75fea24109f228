"""Variants of BGPO, by what their policies read."""

from bgpo_trl.transforms import TaskSchedule

# By name: state, meaning of the context, and the algorithm whose settings it has.
VARIANTS = {
    "ground truth, label": ("state", "label", "oracle"),
    "latent, label": ("latent", "label", "oracle"),
    "latent, nothing": ("latent", "nothing", "ddpg"),
    "latent, phi": ("latent", "phi", "without-gwr"),
    "latent, b": ("latent", "b", "bgpo-single"),
    "group-balanced replay": ("latent", "b", "group-balanced-replay"),
    "experts": ("latent", "b", "bgpo-experts"),
    "all": ("latent", "b", "bgpo"),
}
# More groups than are active.
GROUPS = {"group_size": 4, "group_evidence": 0.5, "active_groups": 2}
CHANGES = {"group-balanced replay": GROUPS, "experts": GROUPS, "all": GROUPS}
SCHEDULE = TaskSchedule((0, 2, 4))
