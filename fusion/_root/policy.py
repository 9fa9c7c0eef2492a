"""The weighting policy: class of ground to the noise of each sensor.

policy = terrafusion.policy.load()                       # the shipped one, or a file
policy = terrafusion.policy.fit("policy.yaml", seeds=3)  # from drives of the twin and labelled logs
"""

from collections.abc import Callable, Sequence
from pathlib import Path

from terrafusion.datasets.core.arguments import checked_path, checked_progress, checked_whole
from terrafusion.fusion.noise.policy import Policy, SensorNoise
from terrafusion.fusion.noise.policy import load_policy as load

__all__ = ["Policy", "SensorNoise", "fit", "load"]


def fit(
    out: str | Path,
    *,
    seeds: int = 3,
    vehicle: str = "elevate",
    logs: Sequence[str | Path] = (),
    progress: Callable[[], None] | None = None,
) -> Policy:
    """Fit a policy to drives of the twin on every ground, and to labelled logs, and write its file.

    Made again with the same parameter files and logs, the file has the same bytes.

    Args:
        out: the YAML file.
        seeds: drives of each condition, at least one.
        vehicle: name of a vehicle of the library, which the drives are made with.
        logs: labelled logs of that vehicle.
        progress: called after each drive.

    Raises:
        ConfigError: an unknown vehicle.
        DataError: a log without labels or reference.
    """
    from terrafusion.fusion.training.policy_fit import LoggedSamples, default_grid, fit_policy, write_policy
    from terrafusion.fusion.training.policy_logs import read_logs
    from terrafusion.fusion.training.simulated_runs import GROUNDS

    file = checked_path(out, "out")
    checked_whole(seeds, "seeds", 1)
    checked_progress(progress)
    logged = read_logs([str(log) for log in logs], vehicle) if logs else LoggedSamples()
    fitted = fit_policy(default_grid(seeds, tuple(GROUNDS), vehicle), progress or (lambda: None), logged)
    write_policy(fitted, file, made_by=f"terrafusion.policy.fit, seeds {seeds}, vehicle {vehicle}")
    return load(file)
