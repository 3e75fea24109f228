"""Loggers that keep what they get, in place of services."""

from torchrl.record.loggers.common import Logger


class Recorder(Logger):
    """Logger of a user, who subclasses TorchRL's.

    Attributes:
        metrics: Pairs of metrics and step.
        settings: Hyperparameters.
        media: Pairs of name and path.
        closed: Whether it was shut down.
    """

    def __init__(self):
        super().__init__("run", "")
        self.metrics, self.settings, self.media, self.closed = [], [], [], False

    def _create_experiment(self):
        return None

    def log_metrics(self, metrics, step=None, *, keys_sep="/"):
        assert not self.closed
        self.metrics.append((metrics, step))
        return metrics

    def log_hparams(self, cfg):
        self.settings.append(cfg)

    def log_media(self, name, path):
        assert not self.closed
        self.media.append((name, path))

    def shutdown(self, timeout=None):
        self.closed = True
