import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nurec_sim import geometry, sensors
from nurec_sim.types import LidarModel, Spin

ROWS = {"PANDAR128": 128, "AT128": 128, "HDL-64": 64, "HDL-32": 32, "VLP-16": 16}
SPAN_DEG = {
    "PANDAR128": (15, -25),
    "AT128": (12.9, -12.5),
    "HDL-64": (2, -24.33),
    "HDL-32": (10.67, -30.67),
    "VLP-16": (15, -15),
}


def lidar(name: str = "VLP-16", **changes) -> LidarModel:
    return dataclasses.replace(sensors.lidar_model(name, np.eye(4), columns=360), **changes)


def with_offsets(name: str) -> LidarModel:
    model = lidar(name)
    offsets = np.deg2rad(np.where(np.arange(len(model.elevation_rad)) % 2, 3.0, -2.5))
    return dataclasses.replace(model, row_azimuth_offset_rad=offsets)


@pytest.mark.parametrize("name", list(ROWS))
def test_tables_have_the_data_sheets_rows_and_spans(name):
    model = sensors.lidar_model(name, np.eye(4))
    sensors.check_lidar(model)
    assert len(model.elevation_rad) == ROWS[name] and model.id == name
    assert np.allclose(np.rad2deg(model.elevation_rad[[0, -1]]), SPAN_DEG[name], atol=0.011)
    directions = sensors.beam_directions(model)
    assert directions.shape == (ROWS[name], len(model.azimuth_rad), 3)
    assert np.allclose(np.linalg.norm(directions, axis=-1), 1)


def test_pandar128_is_finest_around_the_horizon():
    steps = -np.diff(np.rad2deg(sensors.lidar_model("PANDAR128", np.eye(4)).elevation_rad))
    assert np.allclose(np.unique(steps.round(6)), (0.125, 0.5, 1.0))
    assert np.count_nonzero(steps.round(6) == 0.125) == 64


def test_at128_covers_120_degrees_ahead_and_the_others_a_full_turn():
    azimuth = np.rad2deg(sensors.lidar_model("AT128", np.eye(4)).azimuth_rad)
    assert azimuth[0] == pytest.approx(60) and azimuth[-1] == pytest.approx(-59.9)
    turn = np.rad2deg(lidar("HDL-64").azimuth_rad)
    assert turn[0] == pytest.approx(180) and turn[-1] == pytest.approx(-179) and turn[180] == pytest.approx(0)


@pytest.mark.parametrize("spin", list(Spin))
@pytest.mark.parametrize("name", ["HDL-64", "AT128"])
def test_beams_meet_points_along_them_at_their_own_place(name, spin):
    model = with_offsets(name)
    if spin is Spin.COUNTERCLOCKWISE:
        model = dataclasses.replace(model, spin=spin, azimuth_rad=-model.azimuth_rad)
    sensors.check_lidar(model)
    directions = sensors.beam_directions(model)
    row, column, valid = sensors.beam_coordinates(model, 25 * directions.reshape(-1, 3))
    rows, columns = np.indices(directions.shape[:2])
    assert valid.all()
    assert np.allclose(row, rows.ravel()) and np.allclose(column, columns.ravel())


@settings(max_examples=100, deadline=None)
@given(
    name=st.sampled_from(list(ROWS)),
    share=st.floats(0.01, 0.99),
    column=st.floats(-0.45, 359.45),
    seed=st.integers(0, 1000),
)
def test_fractional_places_lie_between_beams(name, share, column, seed):
    model = lidar(name)
    row = seed % (ROWS[name] - 1)
    elevation = (1 - share) * model.elevation_rad[row] + share * model.elevation_rad[row + 1]
    azimuth = model.azimuth_rad[0] + column * (model.azimuth_rad[1] - model.azimuth_rad[0])
    flat = np.cos(elevation)
    point = 9 * np.array([[flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)]])
    found_row, found_column, valid = sensors.beam_coordinates(model, point)
    assert valid[0]
    assert found_row[0] == pytest.approx(row + share) and found_column[0] == pytest.approx(column)


def test_points_outside_of_the_grid_or_undefined_are_not_valid():
    above, behind = [0.1, 0, 5.0], [-10.0, 0.1, 0]
    points = np.array([above, behind, [0, 0, 0], [0, 0, 3], [np.nan, 1, 1], [10.0, 0.3, 0.2]])
    assert sensors.beam_coordinates(lidar("AT128"), points)[2].tolist() == [False] * 5 + [True]
    assert len(sensors.beam_coordinates(lidar("AT128"), np.zeros((0, 3)))[0]) == 0


def test_columns_fire_evenly_from_start_to_end():
    fraction = sensors.column_fraction(lidar())
    assert fraction[0] == 0 and fraction[-1] == 1 and np.allclose(np.diff(fraction), 1 / 359)
    assert sensors.column_fraction(lidar(azimuth_rad=np.zeros(1))).tolist() == [0]


def test_compensation_puts_a_wall_seen_on_the_move_back_in_one_plane():
    fired = np.stack([geometry.pose_from_xyyaw(2 * s, 0.3 * s, 0.1 * s) for s in np.linspace(-0.5, 0.5, 50)])
    wall = np.stack([np.full(50, 20.0), np.linspace(-5, 5, 50), np.linspace(0, 2, 50)], axis=1)
    measured = np.concatenate(
        [geometry.transform_points(geometry.inverse(pose), wall[i : i + 1]) for i, pose in enumerate(fired)]
    )
    reference = geometry.pose_from_xyyaw(0.5, 0.1, 0.02)
    points = sensors.compensate_sweep(measured, fired, reference)
    assert np.allclose(geometry.transform_points(reference, points), wall)


@pytest.mark.parametrize(
    "changes, text",
    [
        ({"elevation_rad": np.zeros(0)}, "elevation_rad must be a list of at least 1 finite angle"),
        ({"azimuth_rad": np.array([np.nan])}, "azimuth_rad must be a list of at least 1 finite angle"),
        ({"row_azimuth_offset_rad": np.zeros(3)}, "16 rows but 3 row_azimuth_offset_rad"),
        ({"elevation_rad": np.linspace(-0.2, 0.2, 16)}, "elevation_rad must fall from row to row"),
        ({"spin": Spin.COUNTERCLOCKWISE}, "azimuth_rad must run counterclockwise from column to column"),
        ({"range_m": (5.0, 2.0)}, r"range_m must be \(near, far\)"),
        ({"frequency_hz": 0.0}, "frequency_hz must be positive, got 0.0"),
        ({"rig_from_lidar": 2 * np.eye(4)}, "rig_from_lidar has a 3 x 3 part that is not a rotation"),
    ],
)
def test_check_lidar_says_what_is_wrong(changes, text):
    with pytest.raises(ValueError, match=text):
        sensors.check_lidar(lidar(**changes))


def test_unknown_tables_and_columns_are_refused():
    with pytest.raises(ValueError, match="no LiDAR table 'OS1'; have .*'HDL-64'"):
        sensors.lidar_model("OS1", np.eye(4))
    with pytest.raises(ValueError, match="needs at least 1 column, got 0"):
        sensors.lidar_model("AT128", np.eye(4), columns=0)


@pytest.mark.parametrize(("beams", "valid"), [(0.48, True), (0.52, False)])
def test_a_scanner_ends_half_a_beam_beyond_its_outermost_beams(beams, valid):
    model = lidar("AT128")
    step_up = model.elevation_rad[0] - model.elevation_rad[1]
    step_down = model.elevation_rad[-2] - model.elevation_rad[-1]
    step_aside = abs(model.azimuth_rad[1] - model.azimuth_rad[0])
    ahead = model.azimuth_rad[len(model.azimuth_rad) // 2]
    places = [
        (model.elevation_rad[0] + beams * step_up, ahead),
        (model.elevation_rad[-1] - beams * step_down, ahead),
        (model.elevation_rad[40], model.azimuth_rad[0] + beams * step_aside),
        (model.elevation_rad[40], model.azimuth_rad[-1] - beams * step_aside),
    ]
    points = [[np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)] for up, turn in places]
    assert sensors.beam_coordinates(model, 12 * np.array(points))[2].tolist() == [valid] * 4
