"""Variants of BGPO, by what their policies read."""

from bgpo_trl.transforms import TaskSchedule

# By name: state, meaning of the context, variant, and the algorithm whose settings it has.
VARIANTS = {
    "ground truth, label": ("state", "label", "label", "oracle"),
    "latent, label": ("latent", "label", "label", "oracle"),
    "latent, nothing": ("latent", "nothing", "no-context", "ddpg"),
    "latent, phi": ("latent", "phi", "without-gwr", "bgpo-single"),
    "latent, b": ("latent", "b", "published", "bgpo-single"),
    "group-balanced replay": ("latent", "b", "bgpo", "bgpo-single"),
    "experts": ("latent", "b", "bgpo", "bgpo-experts"),
    "all": ("latent", "b", "bgpo", "bgpo"),
}
# More groups than are active.
GROUPS = {"group_size": 4, "group_evidence": 0.5, "active_groups": 2}
CHANGES = {
    "group-balanced replay": {"group_balanced_replay": True, **GROUPS},
    "experts": GROUPS,
    "all": GROUPS,
}
SCHEDULE = TaskSchedule((0, 2, 4))
