"""The weighting of each mode, by its name in the configuration."""

from __future__ import annotations

from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.weighting.innovation import InnovationWeighting
from terrafusion.fusion.weighting.robust import RobustWeighting
from terrafusion.fusion.weighting.weighting import NoiseInForce, Weighting


def weighting_for(config: EstimatorConfig, noise: NoiseInForce) -> Weighting:
    """The weighting of the mode asked for; what it changes is recorded in `noise`."""
    if config.mode == "robust":
        return RobustWeighting(config, noise)
    if config.mode == "innovation":
        return InnovationWeighting(config, noise)
    return Weighting()
