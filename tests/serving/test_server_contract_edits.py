"""``edit_assets`` and ``restore_model_parameters``: what clients see and what is drawn."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from grpc import StatusCode as Code
from serving_calls import (
    Gated,
    Stub,
    blue_count,
    camera_message,
    pixels,
    place,
    red_count,
    refusal,
    street_stub,
    wait_until,
)
from serving_world import LAST_US, START_US, scene

from nurec_sim import geometry
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.wire import sensorsim
from nurec_sim.serving.wire.requests import write_poses


@pytest.fixture(scope="module")
def server():
    with street_stub(max_edited_scenes=1) as stub:
        yield stub


@pytest.fixture
def stub(server):
    yield server
    for name in ("street", "other"):
        server.restore_model_parameters(sensorsim.RestoreModelParametersRequest(scene_id=name))


def edit(scene_id="street"):
    return sensorsim.EditAssetsRequest(scene_id=scene_id)


def insertion(request, track_id="new", asset_id="car-1", x=14.0, y=0.5, times=(START_US, LAST_US)):
    entry = request.insert.add(id=track_id, asset_id=asset_id, semantic_class="automobile")
    for t_us in times:
        sample = entry.trajectory.poses.add(timestamp_us=t_us)
        write_poses(geometry.pose_from_xyyaw(x, y, 0.0, 0.8)[None], [sample.pose])
    return entry


def draw(stub, scene_id="street"):
    return pixels(stub.render_rgb(camera_message(scene_id=scene_id)))


def tracks(stub, scene_id="street"):
    reply = stub.get_dynamic_objects(sensorsim.DynamicObjectsRequest(scene_id=scene_id))
    return {track.id: track for track in reply.dynamic_objects}


def external(stub, scene_id="street"):
    return list(stub.get_external_asset_objects(sensorsim.ExternalAssetObjectsRequest(scene_id=scene_id)).track_ids)


def test_an_inserted_actor_is_drawn_listed_and_can_be_moved(stub):
    plain = draw(stub)
    request = edit()
    insertion(request)
    reply = stub.edit_assets(request)
    assert reply.success and reply.message == "0 replaced or removed, 1 inserted"
    grown = draw(stub)
    assert red_count(grown) > 1.5 * red_count(plain) > 0
    assert list(tracks(stub)) == ["car-1", "parked-1", "new"] and external(stub) == ["new"]
    assert tracks(stub)["new"].asset_id == "car-1"
    size = tracks(stub)["new"].object_size
    np.testing.assert_allclose((size.size_x, size.size_y, size.size_z), (4.4, 1.8, 1.6), rtol=1e-6)
    message = camera_message()
    place(message, "new", geometry.pose_from_xyyaw(14, 0.5, 0, -100))
    assert np.array_equal(pixels(stub.render_rgb(message)), plain), "what was put in can be buried again"
    stub.restore_model_parameters(sensorsim.RestoreModelParametersRequest(scene_id="street"))
    assert np.array_equal(draw(stub), plain) and external(stub) == [] and list(tracks(stub)) == ["car-1", "parked-1"]


def test_a_replaced_actor_takes_the_looks_of_another(stub):
    plain = draw(stub)
    request = edit()
    request.replace.add(original_id="car-1", replacement_id="parked-1")
    request.replace.add(original_id="parked-1", replacement_id="car-1")
    assert stub.edit_assets(request).success
    swapped = draw(stub)
    assert blue_count(plain) > 100 and red_count(plain) > 100
    assert red_count(swapped) != red_count(plain) and blue_count(swapped) != blue_count(plain)
    assert red_count(swapped) > 100 and blue_count(swapped) > 100, "looks are those from before the request"
    assert external(stub) == ["car-1", "parked-1"] and tracks(stub)["car-1"].asset_id == "parked-1"


def test_a_replacement_is_scaled_to_the_size_that_is_asked_for(stub):
    request = edit()
    entry = request.replace.add(original_id="car-1", replacement_id="car-1")
    entry.object_size.size_x, entry.object_size.size_y, entry.object_size.size_z = 8.8, 3.6, 3.2
    plain = red_count(draw(stub))
    assert stub.edit_assets(request).success
    assert red_count(draw(stub)) > 2 * plain
    track = tracks(stub)["car-1"]
    assert track.object_size.size_z == np.float32(3.2) and track.trajectory.poses[0].pose.vec.z == np.float32(1.6)


def test_an_empty_replacement_takes_an_actor_away(stub):
    request = edit()
    request.replace.add(original_id="car-1")
    request.replace.add(original_id="parked-1")
    assert stub.edit_assets(request).success
    image = draw(stub)
    assert red_count(image) == blue_count(image) == 0 and tracks(stub) == {} and external(stub) == []


def test_looks_can_come_from_another_scene(stub):
    request = edit()
    insertion(request, asset_id="clipgt-other/parked-1")
    plain = draw(stub)
    assert stub.edit_assets(request).success
    assert blue_count(draw(stub)) > 1.3 * blue_count(plain)
    assert tracks(stub)["new"].asset_id == "clipgt-other/parked-1"


def test_edits_add_up_and_other_scenes_are_not_touched(stub):
    before = draw(stub, "other")
    for name, x in (("a", 12.0), ("b", 18.0)):
        request = edit("clipgt-street")
        insertion(request, name, x=x)
        stub.edit_assets(request)
    assert external(stub) == ["a", "b"]
    assert np.array_equal(draw(stub, "other"), before) and external(stub, "other") == []
    request = edit("other")
    insertion(request)
    code, text = refusal(stub.edit_assets, request)
    assert code == Code.RESOURCE_EXHAUSTED and "1 scenes are edited" in text


def test_of_edits_at_the_same_time_no_more_are_kept_than_allowed(stub):
    def insert_into(name):
        request = edit(name)
        insertion(request)
        call = stub.edit_assets.future(request, timeout=30)
        return call.exception() and call.exception().code()

    with ThreadPoolExecutor(2) as pool:
        codes = list(pool.map(insert_into, ("street", "other")))
    assert set(codes) == {None, Code.RESOURCE_EXHAUSTED}


def test_frames_in_progress_are_rendered_from_what_they_began_with():
    made = []

    def gated(world):
        made.append(Gated(world))
        return made[-1]

    store = SceneStore([scene()], make_renderer=gated)
    with SensorServer(store, port=0) as address, Stub(address) as stub:
        early = stub.render_rgb.future(camera_message(), timeout=60)
        wait_until(lambda: made and made[0].begun)
        request = edit()
        request.replace.add(original_id="car-1")
        assert stub.edit_assets(request, timeout=30).success
        late = stub.render_rgb.future(camera_message(), timeout=60)
        for renderer in made:
            renderer.gate.set()
        assert red_count(pixels(early.result())) > 100 and red_count(pixels(late.result())) == 0


def test_edits_at_the_same_time_all_count(stub):
    requests = [edit() for _ in range(6)]
    for i, request in enumerate(requests):
        insertion(request, f"n{i}", x=10.0 + i)
    for call in [stub.edit_assets.future(request, timeout=60) for request in requests]:
        assert call.result().success
    assert sorted(external(stub)) == [f"n{i}" for i in range(6)]


def wrong_size(request):
    entry = insertion(request)
    entry.object_size.size_x = float("nan")


WRONG = {
    "an unknown track": (
        lambda r: r.replace.add(original_id="x", replacement_id="car-1"),
        Code.INVALID_ARGUMENT,
        "replace[0]: scene 'street' has no track 'x'; have ['car-1', 'parked-1']",
    ),
    "an unknown asset": (
        lambda r: insertion(r, asset_id="x"),
        Code.INVALID_ARGUMENT,
        "insert[0]: scene 'street' has no track 'x'",
    ),
    "an asset of an unknown scene": (
        lambda r: insertion(r, asset_id="nowhere/car-1"),
        Code.NOT_FOUND,
        "asset 'nowhere/car-1' must be a track_id of scene 'street', or scene_id/track_id of another",
    ),
    "no asset": (lambda r: insertion(r, asset_id=""), Code.INVALID_ARGUMENT, "insert[0].asset_id is missing"),
    "no id": (lambda r: insertion(r, ""), Code.INVALID_ARGUMENT, "insert[0].id must be a printable text"),
    "an id that is taken": (lambda r: insertion(r, "car-1"), Code.INVALID_ARGUMENT, "has a track 'car-1' already"),
    "no original": (lambda r: r.replace.add(), Code.INVALID_ARGUMENT, "replace[0].original_id is missing"),
    "no path": (lambda r: insertion(r, times=()), Code.INVALID_ARGUMENT, "a trajectory needs times"),
    "another time": (lambda r: insertion(r, times=(1, 2)), Code.INVALID_ARGUMENT, "lives during [1, 2] us"),
    "no size": (wrong_size, Code.INVALID_ARGUMENT, "insert[0].object_size must lie in 0.01..100 m on each side"),
    "too many": (lambda r: [r.replace.add() for _ in range(1001)], Code.RESOURCE_EXHAUSTED, "1000 edits, got 1001"),
}


def test_one_wrong_edit_undoes_those_before_it(stub):
    plain = draw(stub)
    request = edit()
    insertion(request)
    insertion(request, "other", asset_id="x")
    assert refusal(stub.edit_assets, request)[0] == Code.INVALID_ARGUMENT
    assert np.array_equal(draw(stub), plain) and external(stub) == []


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_edit_is_explained_and_changes_nothing(stub, case):
    change, code, text = WRONG[case]
    plain = draw(stub)
    request = edit()
    change(request)
    got, details = refusal(stub.edit_assets, request)
    assert got == code and text in details
    assert np.array_equal(draw(stub), plain) and external(stub) == []


def test_editing_unknown_scenes_is_not_found(stub):
    assert refusal(stub.edit_assets, edit("x"))[0] == Code.NOT_FOUND
    request = sensorsim.RestoreModelParametersRequest(scene_id="x")
    assert refusal(stub.restore_model_parameters, request)[0] == Code.NOT_FOUND
