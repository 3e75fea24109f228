"""LossModules, each usable on its own with any TorchRL training loop."""
