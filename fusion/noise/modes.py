"""Tuning of the estimator modes, as found by `python -m tests.studies.mode_tuning`."""

import dataclasses
import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from terrafusion.datasets.core.config import structure
from terrafusion.datasets.core.quantity import Quantity, Word
from terrafusion.datasets.core.yaml_file import read_yaml
from terrafusion.fusion.noise.policy import Policy, SensorNoise

SCHEMA = "terrafusion.modes/1"
MODES = ("adaptive", "fixed", "robust", "innovation")
ROBUST_LOSSES = ("cauchy", "gnc")
INNOVATION_METHODS = ("sage_husa", "variational")


@dataclass(frozen=True)
class NoiseTuning:
    """Factors on three standard deviations of a policy's noise; 1 leaves them as fitted."""

    wheel_factor: Annotated[float, Quantity("", 0.01, 100.0)] = 1.0
    slip_factor: Annotated[float, Quantity("", 0.01, 100.0)] = 1.0
    gnss_factor: Annotated[float, Quantity("", 0.01, 100.0)] = 1.0

    def applied(self, noise: SensorNoise) -> SensorNoise:
        """`noise` with the factors applied."""
        return dataclasses.replace(
            noise,
            wheel_sigma_mps=noise.wheel_sigma_mps * self.wheel_factor,
            slip_sigma=noise.slip_sigma * self.slip_factor,
            gnss_inflation=noise.gnss_inflation * self.gnss_factor,
        )

    def applied_to_policy(self, policy: Policy) -> Policy:
        """`policy` with the factors applied to every class."""
        classes = {name: self.applied(noise) for name, noise in policy.classes.items()}
        return dataclasses.replace(policy, classes=classes, fixed=self.applied(policy.fixed))


@dataclass(frozen=True)
class RobustTuning:
    """Scales c of the losses, in sigmas, and the gate beyond which a fix is left out in any case."""

    wheel_c: Annotated[float, Quantity("", 0.1, 1e6)] = 3.0
    gnss_c: Annotated[float, Quantity("", 0.1, 1e6)] = 4.0
    gate_sigma: Annotated[float, Quantity("", 1.0, 1e6)] = 30.0


@dataclass(frozen=True)
class InnovationTuning:
    """Memory, in measurements, and the factor by which the wheels' sigma may leave the tuned one, up and
    down.
    """

    wheel_memory: Annotated[float, Quantity("", 2.0, 1e6)] = 100.0
    gnss_memory: Annotated[float, Quantity("", 2.0, 1e6)] = 50.0
    wheel_span: Annotated[float, Quantity("", 1.0, 100.0)] = 3.0


@dataclass(frozen=True)
class ModeTuning:
    """Tuning by mode.

    `fixed` is also the noise from which "robust" and "innovation" start, and that of "adaptive" on a robot
    that the terrain model does not know, until its slip shows the ground.
    """

    fixed: NoiseTuning = NoiseTuning()
    adaptive: NoiseTuning = NoiseTuning()
    cauchy: RobustTuning = RobustTuning()
    gnc: RobustTuning = RobustTuning()
    sage_husa: InnovationTuning = InnovationTuning()
    variational: InnovationTuning = InnovationTuning()
    inputs_sha256: str = ""


@dataclass(frozen=True, kw_only=True)
class ModesFile(ModeTuning):
    """Keys of a tuning file; all of them, and all of each section, are needed."""

    schema: Annotated[str, Word((SCHEMA,))]
    made_by: str


@functools.cache
def _shipped() -> ModeTuning:
    return load_modes(Path(__file__).with_name("modes.yaml"))


def load_modes(path: Path | None = None) -> ModeTuning:
    """The tuning file `path`, or the one shipped with the library.

    Raises:
        ConfigError: unknown or missing key, wrong type, out of range.
    """
    if path is None:
        return _shipped()
    content = structure(ModesFile, read_yaml(path), file=path, complete=True)
    return ModeTuning(**{f.name: getattr(content, f.name) for f in dataclasses.fields(ModeTuning)})
