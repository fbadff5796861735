"""A pressure sensor that drifts away from the tags is found by the pictures, however the body moves, and one that only differs is not."""

import math

import numpy as np
import pytest

from firmware_py.core.depth_datum import NOISE_M, PICTURES, READINGS, SHIFT_M, DepthDatum

DEPTH_S, PICTURE_S, DELAY_S = 0.02, 1.0 / 60.0, 0.04
NS = 1_000_000_000


class Watched:
    """A datum that is told of a sensor, 0.5 m off and with `noise_m`, and of pictures of a body that goes up and down at 0.5 m/s."""

    def __init__(self, noise_m: float = 0.004, seed: int = 0) -> None:
        self.datum, self._rng, self._noise_m = DepthDatum(), np.random.default_rng(seed), noise_m
        self._readings = self._pictures = 0

    def run(self, seconds: float, drift_m_s: float = 0.0, offset_m: float = 0.0) -> float:
        """Returns the time until the sensor was first said to err, s; infinite if it never was."""
        first_s = self._readings * DEPTH_S
        found_s = math.inf
        for _ in range(round(seconds / DEPTH_S)):
            now_s = self._readings * DEPTH_S
            error_m = 0.5 + offset_m + drift_m_s * (now_s - first_s) + 0.002 * self._rng.normal()
            self.datum.hear(round(now_s * NS), _depth_m(now_s) + error_m)
            self._readings += 1
            while self._pictures * PICTURE_S + DELAY_S <= now_s:
                seen_s = self._pictures * PICTURE_S
                self.datum.compare(round(seen_s * NS), _depth_m(seen_s) + self._noise_m * self._rng.normal())
                self._pictures += 1
            if self.datum.errs:
                found_s = min(found_s, now_s - first_s)
        return found_s


def _depth_m(time_s: float) -> float:
    return 3.0 + 0.25 * math.sin(2.0 * time_s)


@pytest.mark.parametrize("seed", range(5))
def test_healthy_sensor_never_errs_while_the_body_goes_up_and_down(seed: int) -> None:
    watched = Watched(seed=seed)
    assert watched.run(60.0) == math.inf
    assert abs(watched.datum.shift_m) < 0.5 * SHIFT_M


@pytest.mark.parametrize(("drift_m_s", "most_m"), [(0.005, 0.03), (0.02, 0.025), (-0.05, 0.025), (0.2, 0.04)])
def test_drift_is_found_within_a_few_centimetres(drift_m_s: float, most_m: float) -> None:
    watched = Watched()
    watched.run(5.0)
    assert abs(drift_m_s) * watched.run(6.0, drift_m_s) < most_m


def test_drift_from_the_first_picture_on_is_found() -> None:
    assert Watched().run(2.0, 0.2) < 1.0


def test_offset_is_steady_half_a_second_after_a_jump_and_usual_once_it_is_taken_so() -> None:
    watched = Watched()
    watched.run(5.0)
    assert watched.run(0.2, offset_m=0.03) < 0.2 and not watched.datum.is_steady
    watched.run(0.6, offset_m=0.03)
    assert watched.datum.errs and watched.datum.is_steady and watched.datum.shift_m == pytest.approx(0.03, abs=0.006)
    watched.datum.take_as_usual()
    assert watched.run(10.0, offset_m=0.03) == math.inf


def test_limits_grow_with_the_noise_of_the_tags() -> None:
    """Tags of a far camera: a sensor is not to be convicted by their noise."""
    noisy = Watched(noise_m=4.0 * NOISE_M)
    assert noisy.run(60.0) == math.inf
    assert noisy.run(2.0, 0.2) < 1.0


def test_sensor_that_drifts_is_not_taken_as_usual_by_and_by() -> None:
    watched = Watched()
    watched.run(5.0)
    watched.run(20.0, 0.02)
    assert watched.datum.shift_m == pytest.approx(0.4, abs=0.05)


def test_pictures_without_a_reading_before_and_after_are_left_out_and_memory_is_bounded() -> None:
    datum = DepthDatum()
    datum.compare(0, 3.0)
    datum.hear(NS, 3.0)
    datum.compare(NS // 2, 3.0)
    datum.compare(2 * NS, 3.0)
    assert np.isnan(datum._offsets).all() and not datum.errs and datum.is_steady
    for tick in range(5 * READINGS):
        datum.hear((2 + tick) * NS, 3.0)
        datum.compare((2 + tick) * NS - NS // 2, 3.0)
    assert (len(datum._readings), len(datum._offsets)) == (READINGS, PICTURES)
