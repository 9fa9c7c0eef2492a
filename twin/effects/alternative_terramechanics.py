"""A second terramechanics: Reece's pressure, slip-sinkage in the exponent, and a hyperbola for the shear.

What is fitted to the twin's own laws (a weighting policy, a terrain model) can be tested on ground that
obeys others. The form stands outside the catalogue, because no robot's gap to its twin is measured in it;
`second_terramechanics()` makes it known to a process and gives the effects for `simulate`.

Pressure under a plate of width b at the depth z (Reece 1965; Wong 2008, eq. 2.49):

    p = (c k_c' + gamma b k_phi') (z / b)^n        instead of Bekker's (k_c / b + k_phi) z^n

Both laws are fits to plates. Here they agree on a plate of `PLATE_M`, so that c k_c' = k_c b0^(n-1) and
gamma k_phi' = k_phi b0^(n-1), and differ under the wider wheel: with n below 1 it is borne better than
Bekker has it, with n above 1 worse. Sinkage grows with slip by n = n0 + n1 |s| (Ding et al. 2010), where the
twin's own law is z0 (1 + k_ss s).

Shear stress over the displacement j: tau = tau_max j / (K + j) (Kondner 1963), where the twin has
tau_max (1 - exp(-j / K)) (Janosi and Hanamoto 1961): as stiff at first, as strong in the end, softer between.
"""

from typing import Any

import casadi as ca

from terrafusion.twin.effects.catalogue import register
from terrafusion.twin.effects.form import Form, Quantities, one
from terrafusion.twin.physics.smooth import saturate, smooth_abs
from terrafusion.twin.physics.terramechanics import shear_fraction_over_displacement

PLATE_M = 0.05
"""Width of the plate on which both pressure laws agree (assumed: a usual bevameter's smaller one)."""
EXPONENT_GAIN = 0.5
"""n1 of the slip-sinkage law (assumed: it doubles the sinkage of a wheel that spins on sand)."""


def reece_modulus(k_c: Any, k_phi: Any, exponent: Any, width_m: Any, slipped: Any) -> Any:
    """(c k_c' + gamma b k_phi') / b^n', N/m^(n'+2): pressure over z^n' under a wheel of width b.

    `exponent` n is the soil's, which the plate has shown; `slipped` n' the one that slip makes of it.
    """
    return (k_c + width_m * k_phi) * ca.exp((exponent - 1.0) * ca.log(PLATE_M) - slipped * ca.log(width_m))


def hyperbolic_share(ratio: Any) -> Any:
    """Mean shear by the hyperbola over that by the exponential, for x = j / K > 0 at the contact's end.

    With j growing linearly along the contact: (1 - ln(1 + x) / x) / (1 - (1 - exp(-x)) / x); 1 at both ends.
    """
    return (ratio - ca.log(1.0 + ratio)) / (ratio * ratio) / shear_fraction_over_displacement(ratio)


def _ground(q: Quantities, share: Any) -> dict[str, Any]:
    slip = saturate(smooth_abs(q["slip"], 0.01) - 0.01, 1.0)
    exponent = q["exponent"] + share * EXPONENT_GAIN * slip
    modulus = reece_modulus(q["k_c"], q["k_phi"], q["exponent"], q["width_m"], exponent)
    return {
        "k_c": (1.0 - share) * q["k_c"],
        "k_phi": (1.0 - share) * q["k_phi"] + share * modulus,
        "exponent": exponent,
        "slip_sinkage": (1.0 - share) * q["slip_sinkage"],
    }


def _wheel(q: Quantities, share: Any) -> dict[str, Any]:
    shear_square = q["shear_x_m"] * q["shear_x_m"] + q["shear_y_m"] * q["shear_y_m"]
    ratio = ca.sqrt(shear_square / (q["shear_modulus_m"] * q["shear_modulus_m"]) + 1e-4)
    less = share * (hyperbolic_share(ratio) - 1.0)
    out: dict[str, Any] = {}
    for axis in ("x", "y"):
        traction, force = f"traction_{axis}_n", f"force_{axis}_n"
        out |= {traction: q[traction] * (1.0 + less), force: q[force] + less * q[traction]}
    return out


REECE = Form(
    "second_terramechanics", "reece", one("", 1.0, 0.0, 1.0), {"ground": _ground, "wheel": _wheel},
    "Reece's pressure, Bekker's on a plate of 50 mm; n = n0 + n1 abs(s); shear j / (K + j)",
    "Reece 1965; Ding et al. 2010; Kondner 1963", candidate=False,
)  # fmt: skip


def second_terramechanics() -> dict[str, float]:
    """The effects of `simulate` with which the ground obeys the second laws alone."""
    return {register(REECE).key: 1.0}
