"""GWR-B as a scikit-learn estimator; needs the extra ``sklearn``."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
import numpy.typing as npt
import torch

from bgpo_trl.configs import GWRBConfig
from bgpo_trl.modules.gwr import GWRB, checked

try:
    from sklearn.base import BaseEstimator, ClusterMixin, OneToOneFeatureMixin, TransformerMixin
    from sklearn.utils import Tags
    from sklearn.utils.validation import check_is_fitted, validate_data
except ImportError:
    raise ImportError("GWRBEstimator needs scikit-learn: pip install 'bgpo_trl[sklearn]'") from None


class GWRBEstimator(OneToOneFeatureMixin, TransformerMixin, ClusterMixin, BaseEstimator):
    """GWR-B network that learns the rows of a table, once and in their order.

    It starts from the first two rows and computes in float64. A row belongs to the nearest node:
    `predict` returns its identity, `transform` its weights. Identities have gaps where nodes were
    removed or are nearest to no row; this is why scikit-learn's ``check_clustering`` can fail. Its
    ``check_estimator`` passes.

    Args:
        config: The constants, as for `GWRB`. A grid search is over ``{"config": [GWRBConfig(...),
            ...]}``.
        max_nodes: Largest number of nodes; None: no limit.

    Attributes:
        gwr_: The network; its ``graph()`` has the nodes and their edges.
        labels_: Identities of the nodes nearest to the rows learned last, int64 ``[n]``.
        n_features_in_: Number d of columns.
        feature_names_in_: Names of the columns, if X had any.

    Examples:
        >>> model = GWRBEstimator(GWRBConfig(activity_scale=4)).fit([[0.0, 0.0], [1.0, 1.0]])
        >>> model.partial_fit([[0.1, 0.0]]).predict([[0.0, 0.2], [0.9, 1.0]])
        array([0, 1])
        >>> model.transform([[0.0, 0.2]]).round(2)
        array([[0.01, 0.  ]])
    """

    def __init__(self, config: GWRBConfig | None = None, max_nodes: int | None = None) -> None:
        # scikit-learn requires each argument to be stored unchanged under its own name.
        self.config = config
        self.max_nodes = max_nodes

    def fit(self, X: npt.ArrayLike, y: object = None) -> Self:
        """Learn the rows of X ``[n, d]`` with a new network; ``y`` is ignored.

        Raises:
            ValueError: If X holds NaN or Inf, or ``max_nodes`` is below 2.
        """
        rows = _to_tensor(self._validated(X))
        gwr = GWRB(rows.shape[1], self.config, max_nodes=self.max_nodes, init="data")
        return self._learn(gwr.double(), rows)

    def partial_fit(self, X: npt.ArrayLike, y: object = None) -> Self:
        """Learn further rows of X ``[n, d]``; the first call is the same as `fit`.

        Raises:
            ValueError: As `fit`, and if d has changed; nothing is learned then.
        """
        if not hasattr(self, "gwr_"):
            return self.fit(X)
        return self._learn(self.gwr_, _to_tensor(self._validated(X, reset=False)))

    def predict(self, X: npt.ArrayLike) -> np.ndarray:
        """Return the identity of the node nearest to each row of X ``[n, d]``, int64 ``[n]``."""
        rows = self._rows(X)
        return self.gwr_.lookup(rows).node.numpy()

    def transform(self, X: npt.ArrayLike) -> np.ndarray:
        """Return the weights of the nearest node, ``[n, d]``; float32 if X is, else float64."""
        rows = self._rows(X)
        return self.gwr_.lookup(rows).embedding.numpy().astype(rows.dtype)

    def _rows(self, X: npt.ArrayLike) -> np.ndarray:
        check_is_fitted(self, "gwr_")
        return self._validated(X, reset=False, dtype=[np.float64, np.float32])

    def _validated(self, X: Any, **how: Any) -> np.ndarray:  # scikit-learn declares no types
        return np.asarray(validate_data(self, X, **how))

    def _learn(self, gwr: GWRB, rows: torch.Tensor) -> Self:
        for row in rows:
            gwr.adapt(row)
        self.gwr_ = gwr
        self.labels_ = gwr.lookup(rows).node.numpy()
        return self

    def __sklearn_tags__(self) -> Tags:
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = ["float64", "float32"]
        return tags


def _to_tensor(X: npt.ArrayLike) -> torch.Tensor:
    """Check all rows before any of them is learned."""
    rows = torch.from_numpy(np.array(X, np.float64))
    return checked(rows, rows, "X")
