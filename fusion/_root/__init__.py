"""Terrain-aware localisation of ground robots, and the honest comparison of a robot with its twin.

    import terrafusion as tf

    log = tf.open("drive.bag")                          # any readable log -> Recording
    result = tf.replay(log, outages=[(60, 30)])         # estimate and score it -> Replay
    run = tf.simulate("figure_eight", terrain="mud")    # a drive of the twin -> Recording
    answer = tf.diagnose(runs, references=normal)       # robot against twin -> Diagnosis

Frames follow REP-103 and REP-105: world ENU, body x forward, y left, z up. Times are int64 nanoseconds;
every other unit stands in the name (`_m`, `_mps`, `_rad`, ...). A vehicle is a name, a YAML file or a
`Vehicle`. Names are loaded when they are first used, so that importing the package is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import terrafusion.policy as policy
    from terrafusion.datasets.core.errors import ConfigError as ConfigError
    from terrafusion.datasets.core.errors import DataError as DataError
    from terrafusion.datasets.core.errors import TerrafusionError as TerrafusionError
    from terrafusion.datasets.core.recording import Recording as Recording
    from terrafusion.fusion.api.calibrations import calibrate_sensors as calibrate_sensors
    from terrafusion.fusion.api.diagnoses import Diagnosis as Diagnosis
    from terrafusion.fusion.api.diagnoses import diagnose as diagnose
    from terrafusion.fusion.api.logs import open as open
    from terrafusion.fusion.api.replays import Replay as Replay
    from terrafusion.fusion.api.replays import replay as replay
    from terrafusion.fusion.api.studies import benchmark as benchmark
    from terrafusion.fusion.api.studies import sweep as sweep
    from terrafusion.fusion.config.estimator_config import EstimatorConfig as EstimatorConfig
    from terrafusion.fusion.estimate.estimate import Estimate as Estimate
    from terrafusion.fusion.estimator.estimator import Estimator as Estimator
    from terrafusion.twin.calibrate.calibrate import calibrate as calibrate
    from terrafusion.twin.model.vehicle import VehicleParams as Vehicle
    from terrafusion.twin.simulate import simulate as simulate

_HOMES = {
    "ConfigError": "datasets.core.errors:ConfigError",
    "DataError": "datasets.core.errors:DataError",
    "Diagnosis": "fusion.api.diagnoses:Diagnosis",
    "Estimate": "fusion.estimate.estimate:Estimate",
    "Estimator": "fusion.estimator.estimator:Estimator",
    "EstimatorConfig": "fusion.config.estimator_config:EstimatorConfig",
    "Recording": "datasets.core.recording:Recording",
    "Replay": "fusion.api.replays:Replay",
    "TerrafusionError": "datasets.core.errors:TerrafusionError",
    "Vehicle": "twin.model.vehicle:VehicleParams",
    "benchmark": "fusion.api.studies:benchmark",
    "calibrate": "twin.calibrate.calibrate:calibrate",
    "calibrate_sensors": "fusion.api.calibrations:calibrate_sensors",
    "diagnose": "fusion.api.diagnoses:diagnose",
    "open": "fusion.api.logs:open",
    "policy": "policy:",
    "replay": "fusion.api.replays:replay",
    "simulate": "twin.simulate:simulate",
    "sweep": "fusion.api.studies:sweep",
}

__all__ = [
    "ConfigError", "DataError", "Diagnosis", "Estimate", "Estimator", "EstimatorConfig", "Recording",
    "Replay", "TerrafusionError", "Vehicle", "__version__", "benchmark", "calibrate", "calibrate_sensors",
    "diagnose", "open", "policy", "replay", "simulate", "sweep",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        found: Any = version("terrafusion")
    elif name in _HOMES:
        module, _, attribute = _HOMES[name].partition(":")
        home = import_module(f"terrafusion.{module}")
        found = getattr(home, attribute) if attribute else home
    else:
        raise AttributeError(f"module 'terrafusion' has no attribute '{name}'")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted(__all__)
