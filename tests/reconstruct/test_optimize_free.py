"""Gaussians that a fit brings into space which recorded beams crossed."""

import numpy as np
import pytest

from nurec_sim.reconstruct.optimize.adam import MEAN, OPACITY
from nurec_sim.reconstruct.optimize.free import recorded_beams, take_out
from nurec_sim.reconstruct.optimize.parameters import Parameters
from nurec_sim.reconstruct.optimize.placing import LEAST_OPACITY


@pytest.fixture(scope="module")
def beams(street):
    return recorded_beams(street, {1})


def test_beams_of_sweeps_held_out_are_not_read(street, beams):
    times = [sweep.t_us[0] for sweep in beams]
    assert times == [int(street.t_us[k]) for k in (0, 2, 3)]


def test_what_a_step_brings_into_free_space_is_taken_out(lifted, beams):
    parameters = Parameters(lifted)
    # Four metres ahead of the start and a metre above the road; the same for one that no step has changed.
    parameters.values[:2, MEAN : MEAN + 3] = (6.0, 0.0, 1.0)
    parameters.visits[[0, 2]] = 1
    assert take_out(parameters, beams).tolist() == [0]
    opacity = 1 / (1 + np.exp(-parameters.values[:3, OPACITY]))
    assert opacity[0] < LEAST_OPACITY < opacity[1:].min()
    assert parameters.at(lifted.span_us[0]).world.opacity[0] == pytest.approx(opacity[0])
    assert take_out(parameters, beams).tolist() == [], "what is out already is not counted again"
