"""The street behind a server, and its renderer."""

import pytest
from serving_calls import street_renderer, street_stub


@pytest.fixture(scope="module")
def stub():
    with street_stub() as stub:
        yield stub


@pytest.fixture(scope="module")
def renderer():
    return street_renderer()
