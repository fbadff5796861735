"""Carries a thruster's trial over to the body that follows when bodies join or part. Part of `missing_thrust`.

The residual that the trial compares with is another one in the new body, so it begins there from the start, for the same thruster: a trial
dropped here would leave a thruster out for the rest of the flight that a wall had got convicted just before a dock. The wrenches of
what may push are the same, about another centre of mass. What was there before the push is the sum of the bodies that join; how it
divides among parts is known only roughly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from firmware_py.core.body import BUOYANCY_SIGMA_N, Body
from firmware_py.core.names import places_of
from firmware_py.core.thruster_trial import ThrusterTrial
from firmware_py.core.topology import BIAS_SPREAD, moved_wrench


class Held(NamedTuple):
    """What a body hands over when it joins another or parts."""

    body: Body
    trial: ThrusterTrial | None
    residual: np.ndarray | None
    """(6,) wrench residual lately, N and N m, body frame; None if unknown."""


def carried_over(before: Sequence[Held], body: Body, sigma: np.ndarray) -> ThrusterTrial | None:
    """Returns the trial to begin in `body`: of the first body before that has one about a thruster of `body`; None if there is none, or if
    the residual of a body that joins it is unknown.

    Args:
        before: the body that parts, or those that join.
        sigma: (6,) standard deviation of the residual of a healthy `body`.
    """
    places = places_of(body)
    for held in before:
        if held.trial is None or (place := places_of(held.body)[held.trial.thruster]) not in places:
            continue
        found = _divided(held, held.trial, body, sigma) if len(before) == 1 else _added(held, held.trial, before, body, sigma)
        if found is not None:
            return held.trial.again(places.index(place), moved_wrench(held.body, body), *found)
    return None


def _added(
    held: Held, trial: ThrusterTrial, before: Sequence[Held], body: Body, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns the residual before the push (6,) in a joined body, and its sigma (6,); None if that of another part is unknown.

    A residual force has a moment about the new centre of mass if it is a force, and none if it is the bias of an accelerometer times the
    mass. Which share is a force is unknown: half of it, plus or minus half.
    """
    base, doubt = np.zeros(6), np.zeros(3)
    for each in before:
        residual = trial.base if each is held else each.residual
        if residual is None:
            return None
        moved = moved_wrench(each.body, body)
        half = 0.5 * moved[3:, :3] @ residual[:3]
        base += moved @ residual
        base[3:] -= half
        doubt = np.hypot(doubt, half)
    return base, np.hypot(sigma, np.r_[np.zeros(3), doubt])


def _divided(held: Held, trial: ThrusterTrial, body: Body, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the same in a part: a share by mass, as the estimator divides its disturbance. The true share differs by the part's own
    buoyancy, trim and righting arm, and by the biases of its accelerometers, of which a body knows the mean.
    """
    turn, share = moved_wrench(held.body, body)[:3, :3], body.rigid_mass_kg / held.body.rigid_mass_kg
    count = len(body.modules)
    bias_n = BIAS_SPREAD[3] * np.diag(body.mass)[:3] * np.sqrt(1.0 / count - 1.0 / len(held.body.modules))
    own = np.r_[np.hypot(BUOYANCY_SIGMA_N * np.sqrt(count), bias_n), body.righting_sigma]
    return share * np.r_[turn @ trial.base[:3], turn @ trial.base[3:]], np.hypot(sigma, own)
