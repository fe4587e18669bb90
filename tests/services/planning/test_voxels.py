"""The grid says what OctoMap says, and keeps the clearance."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.bus.messages import MalformedMessageError, Octomap, header
from services.bus.octomaps import MalformedMap, sound_map
from services.planning.voxels import CLOSE, FREE, NEAR, OCCUPIED, VoxelGrid, unpack
from tests.services.planning.maps import HIGH, LOW, RESOLUTION_M, box, grid, open_space, payload, tree


def centres(of: VoxelGrid) -> NDArray[np.float64]:
    return of.origin + (np.argwhere(of.levels >= FREE) + 0.5) * of.resolution_m


def test_occupied_is_what_octomap_holds_occupied() -> None:
    draw = np.random.default_rng(1)
    spots = draw.uniform(LOW - 5, HIGH + 5, (300, 3))
    solid = box((3.0, 3.0, 2.0), (11.0, 11.0, 10.0))  # pruned to large leaves
    octree = tree(np.vstack([spots, solid]), draw.uniform(LOW - 5, HIGH + 5, (300, 3)))
    unpacked = unpack(payload(octree), RESOLUTION_M, LOW, HIGH)
    labels = octree.getLabels(centres(unpacked))
    assert ((unpacked.levels.ravel() == OCCUPIED) == (labels == 1)).all()


def test_the_levels_fall_off_with_the_distance() -> None:
    pillar = grid(box((10.0, 0.0, 4.0), (10.5, 0.5, 4.5)), box((5.0, -5.0, 0.0), (16.0, 6.0, 9.0)))
    levels = [pillar.level(np.array([10.25 + away, 0.25, 4.25])) for away in (0.0, 0.5, 1.5, 2.0, 2.5, 4.0)]
    assert levels == [OCCUPIED, CLOSE, CLOSE, NEAR, FREE, FREE]
    heights = [pillar.level(np.array([11.25, 0.25, 4.25 + above])) for above in (-1.0, -0.5, 0.0, 0.5, 1.0)]
    assert heights == [FREE, CLOSE, CLOSE, CLOSE, FREE]


def test_obstacles_outside_the_box_reach_into_it() -> None:
    beside = grid(box((10.0, 21.0, 4.0), (10.5, 21.5, 4.5)))
    assert beside.level(np.array([10.25, 19.75, 4.25])) == CLOSE


def test_what_hides_behind_a_wall_is_kept_out_of_and_what_was_seen_is_not() -> None:
    wall = box((10.0, -4.0, 2.0), (10.5, 4.0, 6.0))
    seen = grid(wall, box((2.0, -8.0, 1.0), (10.0, 8.0, 8.0)))
    assert seen.level(np.array([7.25, 0.25, 4.25])) == FREE
    assert seen.level(np.array([13.25, 0.25, 4.25])) == NEAR
    assert seen.level(np.array([10.25, 0.25, 8.75])) == NEAR  # above, where it was not seen to end
    assert seen.level(np.array([15.25, 0.25, 4.25])) == FREE


def test_outside_the_grid_everything_is_occupied() -> None:
    for point in ([-11.0, 0, 3], [0, 21.0, 3], [0, 0, 0.9], [0, 0, 10.1], [np.nan, 0, 3]):
        assert open_space().level(np.array(point)) == OCCUPIED


def test_an_edge_is_clear_if_every_voxel_on_it_is() -> None:
    draw = np.random.default_rng(2)
    crowded = grid(draw.uniform(LOW, HIGH, (25, 3)), box((-10.0, -20.0, 0.0), (40.0, 20.0, 10.0))[::3])
    verdicts = []
    for _ in range(150):
        a, b = draw.uniform(LOW, HIGH, (2, 3))
        dense = [crowded.level(a + (b - a) * s) for s in np.linspace(0.0, 1.0, 2000)]
        clear = crowded.edge_clear(a, b)
        # A corner that is cut by less than the sampling step may be missed by the sampling only.
        assert clear <= (max(dense) < NEAR)
        verdicts.append(clear == (max(dense) < NEAR))
        assert crowded.edge_clear(b, a) == clear
    assert np.mean(verdicts) > 0.99


def test_edges_along_the_axes_and_of_no_length() -> None:
    wall = grid(box((14.0, -6.0, 0.0), (15.0, 6.0, 11.0)))
    a, b = np.array([0.0, 0.0, 3.0]), np.array([30.0, 0.0, 3.0])
    assert not wall.edge_clear(a, b)
    assert wall.edge_clear(a, a)
    assert wall.edge_clear(a, np.array([0.0, 15.0, 3.0]))
    assert wall.edge_clear(a, np.array([0.0, 0.0, 9.0]))
    assert not wall.edge_clear(a, np.array([0.0, 0.0, 12.0]))
    assert wall.edge_clear(np.array([10.5, 0.0, 3.0]), np.array([12.0, 0.0, 3.0]), limit=OCCUPIED)


def test_a_stream_that_breaks_off_or_goes_on_is_refused() -> None:
    whole = payload(tree(box((3.0, 3.0, 2.0), (9.0, 6.0, 4.0))))
    for length in range(1, len(whole)):
        with pytest.raises(MalformedMap, match="OctoMap"):
            unpack(whole[:length], RESOLUTION_M, LOW, HIGH)
    with pytest.raises(MalformedMap, match="goes on"):
        unpack(whole + b"\x00\x00", RESOLUTION_M, LOW, HIGH)
    with pytest.raises(MalformedMap, match="branches"):
        unpack(b"\x03\x00" * 17, RESOLUTION_M, LOW, HIGH)


@pytest.mark.parametrize("resolution_m", [0.0, -0.5, np.nan, np.inf, 1e-12, 1e12])
def test_a_map_of_absurd_resolution_is_refused(resolution_m: float) -> None:
    message = Octomap(
        header(0, "map"), binary=True, id="OcTree", resolution=resolution_m, data=np.zeros(0, np.int8)
    )
    with pytest.raises(MalformedMessageError, match="resolution"):
        sound_map(message)


@pytest.mark.parametrize(("binary", "kind"), [(False, "OcTree"), (True, "ColorOcTree"), (True, "")])
def test_a_map_of_another_kind_is_refused(binary: bool, kind: str) -> None:
    message = Octomap(header(0, "map"), binary=binary, id=kind, resolution=0.5, data=np.zeros(0, np.int8))
    with pytest.raises(MalformedMap, match="map"):
        sound_map(message)


def test_a_box_that_no_memory_holds_is_refused() -> None:
    with pytest.raises(MalformedMap, match="grid"):
        unpack(b"", 0.5, LOW, np.array([1e5, 1e5, 10.0]))


@given(st.binary(min_size=1, max_size=200))
def test_any_bytes_are_a_map_or_refused(data: bytes) -> None:
    try:
        unpacked = unpack(data, RESOLUTION_M, LOW, HIGH)
    except MalformedMap:
        return
    assert unpacked.levels.shape == (100, 80, 18)
