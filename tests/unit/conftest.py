"""Fixtures of the tests of the ground side; a file that has a world of its own keeps it."""

import pytest

from tests.unit.ground_world import Client, World


@pytest.fixture
def world() -> World:
    return World()


@pytest.fixture
def client(world: World) -> Client:
    return world.client()
