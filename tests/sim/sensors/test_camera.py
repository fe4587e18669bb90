from __future__ import annotations

from math import cos, degrees, radians, sin, tan

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.models.equipment import Camera
from sim.sensors.camera import DepthCamera
from sim.vehicle.airframe import airframe
from sim.vehicle.vehicle import Vehicle
from sim.world import World, make_world
from tests.sim.worlds import world_with

EXACT = Camera(noise_per_m=0.0, quantisation_m=0.0)
CAMERA = DepthCamera(EXACT, seed=0)
AIRSIM = airframe("airsim")
WORLDS = ("clustered", "dense", "factory", "farm", "forest", "gates", "sparse", "traffic")


def points_seen(camera: DepthCamera, vehicle: Vehicle, depth: NDArray[np.float64]) -> NDArray[np.float64]:
    """World points (h, w, 3) at these depths, as perception reprojects them from the intrinsics."""
    v, u = np.indices(depth.shape)
    optical = np.stack(
        [(u - camera.cx) / camera.fx * depth, (v - camera.cy) / camera.fy * depth, depth], axis=-1
    )
    body = np.stack([optical[..., 2], -optical[..., 0], -optical[..., 1]], axis=-1)
    return np.asarray(vehicle.position + body @ vehicle.rotation.T)


def inside(points: NDArray[np.float64], box: NDArray[np.float64], margin: float) -> NDArray[np.bool_]:
    return np.asarray(((points > box[:3] + margin) & (points < box[3:] - margin)).all(axis=-1))


def test_intrinsics_of_the_default_camera() -> None:
    """64 x 36 pixels over 90 degrees; pixel centres lie at whole numbers."""
    assert CAMERA.fx == CAMERA.fy == pytest.approx(32.0)
    assert (CAMERA.cx, CAMERA.cy) == (31.5, 17.5)


def test_a_wall_ahead_has_one_depth() -> None:
    # Hull and camera share the centre: a camera that saw its own hull would report it here.
    vehicle = Vehicle(world_with((8.0, -40.0, -40.0, 9.0, 40.0, 40.0), start=(0.0, 0.0, 30.0)), AIRSIM)
    image = CAMERA.render(vehicle)
    assert image.dtype == np.float32
    assert image.shape == (36, 64)
    assert image == pytest.approx(8.0, abs=1e-5)


@given(st.floats(1.0, 19.9), st.floats(-0.6, 0.6))
@settings(max_examples=25)
def test_depth_of_a_slanted_wall_is_the_analytic_one(distance: float, heading: float) -> None:
    """The wall is x = distance; the nose points ``heading`` off its normal."""
    goal = (50 * np.cos(heading), 50 * np.sin(heading), 40.0)
    wall = (distance, -100.0, 0.0, distance + 1.0, 100.0, 80.0)
    vehicle = Vehicle(world_with(wall, start=(0.0, 0.0, 40.0), goal=goal), AIRSIM)
    image = CAMERA.render(vehicle)
    left = (CAMERA.cx - np.arange(CAMERA.width)) / CAMERA.fx
    depth = distance / (np.cos(heading) - left * np.sin(heading))
    expected = np.where((depth > 0) & (depth <= CAMERA.range_m), depth, np.inf)
    # At the very edge of the range rounding decides.
    clear = np.abs(depth - CAMERA.range_m) > 1e-3
    assert image[:, clear] == pytest.approx(np.tile(expected, (CAMERA.height, 1))[:, clear], rel=1e-5)


@given(
    centre=st.tuples(st.floats(2.5, 18.0), st.floats(-9.0, 9.0), st.floats(0.0, 9.0)),
    size=st.tuples(st.floats(0.3, 3.0), st.floats(0.3, 3.0), st.floats(0.3, 9.0)),
    command=st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-1, 1), st.floats(-1.5, 1.5)),
)
@settings(max_examples=40)
def test_it_never_sees_through_a_box_and_sees_nothing_that_is_not_there(
    centre: tuple[float, ...], size: tuple[float, ...], command: tuple[float, ...]
) -> None:
    box = np.array([*np.subtract(centre, np.divide(size, 2)), *np.add(centre, np.divide(size, 2))])
    vehicle = Vehicle(world_with(box.tolist(), start=(0.0, 0.0, 3.0)), AIRSIM)
    vehicle.advance(np.array(command), 60)
    image = CAMERA.render(vehicle).astype(np.float64)
    seen = np.isfinite(image)
    reach = np.where(seen, image, CAMERA.range_m)
    for fraction in np.linspace(0.02, 1.0, 50):
        on_the_way = points_seen(CAMERA, vehicle, fraction * reach)
        assert not inside(on_the_way, box, margin=1e-4).any()
        assert (on_the_way[..., 2] > -1e-4).all()
    ends = points_seen(CAMERA, vehicle, reach)[seen]
    assert (inside(ends, box, margin=-1e-4) | (np.abs(ends[:, 2]) < 1e-4)).all()


def test_left_is_left_and_down_is_down() -> None:
    vehicle = Vehicle(world_with((5.0, 2.0, 0.0, 6.0, 3.0, 20.0)), AIRSIM)
    image = CAMERA.render(vehicle)
    row = image[0]
    columns = np.flatnonzero(np.isfinite(row))
    # The box spans y / x from 2/6 to 3/5 to the left.
    assert columns.min() == np.ceil(CAMERA.cx - CAMERA.fx * 3 / 5)
    assert columns.max() == np.floor(CAMERA.cx - CAMERA.fx * 2 / 6)
    assert np.isfinite(image[-1]).all(), "the ground, 5 m below"
    assert np.isinf(image[:17, 40:]).all(), "the sky"


def test_range_ends_and_resolution_is_free() -> None:
    vehicle = Vehicle(world_with((8.0, -40.0, -40.0, 9.0, 40.0, 40.0), start=(0.0, 0.0, 30.0)), AIRSIM)
    assert np.isposinf(camera(range_m=7.99).render(vehicle)).all()
    narrow = camera(width=32, height=8, fov_deg=degrees(0.5), range_m=8.01)
    assert narrow.render(vehicle) == pytest.approx(8.0 * np.ones((8, 32)), abs=1e-5)
    assert narrow.fx == pytest.approx(16 / tan(0.25))


def camera(**fields: float) -> DepthCamera:
    return DepthCamera(Camera.model_validate({**EXACT.model_dump(), **fields}), seed=0)


@given(st.floats(1.0, 19.0), st.sampled_from([0.001, 0.01, 0.25]))
@settings(max_examples=15)
def test_depth_is_rounded_to_the_quantisation(distance: float, step: float) -> None:
    wall = (distance, -100.0, 0.0, distance + 1.0, 100.0, 80.0)
    vehicle = Vehicle(world_with(wall, start=(0.0, 0.0, 40.0)), AIRSIM)
    image = camera(quantisation_m=step, height=4).render(vehicle)
    assert np.abs(image - distance).max() <= step / 2 + 1e-5
    assert image / step == pytest.approx(np.rint(image / step), abs=1e-2)


def test_noise_grows_with_the_square_of_depth_and_repeats_with_the_seed() -> None:
    near = Vehicle(world_with((4.0, -90.0, 0.0, 5.0, 90.0, 80.0), start=(0.0, 0.0, 40.0)), AIRSIM)
    far = Vehicle(world_with((8.0, -90.0, 0.0, 9.0, 90.0, 80.0), start=(0.0, 0.0, 40.0)), AIRSIM)
    noisy = Camera(width=128, height=72, noise_per_m=0.002, quantisation_m=0.0)
    errors = [DepthCamera(noisy, 3).render(vehicle) - at for vehicle, at in ((near, 4.0), (far, 8.0))]
    assert np.std(errors[0]) == pytest.approx(0.002 * 16, rel=0.1)
    assert np.std(errors[1]) == pytest.approx(0.002 * 64, rel=0.1)
    assert np.array_equal(DepthCamera(noisy, 3).render(far), errors[1] + np.float32(8.0))
    assert not np.array_equal(DepthCamera(noisy, 4).render(far), DepthCamera(noisy, 3).render(far))
    before = DepthCamera(noisy, 3).render(far)
    far.advance(np.zeros(4), 1)
    assert not np.array_equal(DepthCamera(noisy, 3).render(far), before), "each frame has noise of its own"


def pitch(vehicle: Vehicle, degrees_up: float) -> None:
    half = radians(degrees_up) / 2
    vehicle.data.qpos[3:] = (cos(half), 0.0, -sin(half), 0.0)
    mujoco.mj_forward(vehicle.model, vehicle.data)


def test_a_hit_beyond_the_range_never_comes_back_as_a_near_one() -> None:
    """Noise grows with the square of depth: that of the ground at 465 m is larger than the range."""
    vehicle = Vehicle(world_with(start=(0.0, 0.0, 3.0)), AIRSIM)
    phantoms: list[float] = []
    far = 0
    for seed, degrees_up in enumerate(np.linspace(-8.0, 8.0, 800)):
        pitch(vehicle, degrees_up)
        true = CAMERA.render(vehicle).astype(np.float64)
        seen = DepthCamera(Camera(), seed).render(vehicle).astype(np.float64)
        within, returns = np.isfinite(true), np.isfinite(seen)
        phantoms += seen[returns & ~within].tolist()
        near = returns & within
        assert (np.abs(seen[near] - true[near]) < 6 * 0.001 * true[near] ** 2 + 0.001).all()
        far += bool((~within & np.isfinite(camera(range_m=200.0).render(vehicle))).any())
    assert not phantoms, f"{len(phantoms)} returns of what lies beyond the range, nearest {min(phantoms)} m"
    assert far > 700, "the ground is in view up to the horizon"


FRAMES, EDGE_M = 1250, 1e-6


@pytest.mark.soak
@pytest.mark.parametrize("name", WORLDS)
def test_no_return_is_a_phantom_at_any_attitude(name: str) -> None:
    """Against a ray caster of our own: nothing is seen that is not there, or missed."""
    rng = np.random.default_rng(2027)
    settings, returns, world = Camera(), 0, make_world(name, 5)
    vehicle = Vehicle(world, AIRSIM)
    for frame in range(FRAMES):
        place(vehicle, world, rng)
        eye = DepthCamera(settings, frame)
        seen = eye.render(vehicle).astype(np.float64)
        v, u = np.indices(seen.shape)
        rays = np.stack([np.ones(seen.shape), -(u - eye.cx) / eye.fx, -(v - eye.cy) / eye.fy], axis=-1)
        directions = rays.reshape(-1, 3) @ vehicle.rotation.T
        away = np.maximum(
            world.obstacles[:, :3] - vehicle.position, vehicle.position - world.obstacles[:, 3:]
        )
        near_by = world.obstacles[np.linalg.norm(np.maximum(away, 0.0), axis=1) < 1.6 * settings.range_m]
        # A ray that grazes an edge may meet it or not: between boxes a little larger and a little smaller.
        near, far = (
            cast(vehicle.position, directions, grown(near_by, by), ground).reshape(seen.shape)
            for by, ground in ((EDGE_M, EDGE_M), (-EDGE_M, -EDGE_M))
        )
        met = np.isfinite(seen)
        read_off = 6 * settings.noise_per_m * seen[met] ** 2 * 1.2 + settings.quantisation_m
        assert (seen[met] > near[met] - read_off).all(), (world.name, frame)
        assert (seen[met] < far[met] + read_off).all(), (world.name, frame)
        assert (near[met] <= settings.range_m + 1e-3).all(), (world.name, frame)
        surely = far < settings.range_m - 6 * settings.noise_per_m * settings.range_m**2
        assert not (surely & np.isposinf(seen)).any(), (world.name, frame)
        returns += int(met.sum())
    assert returns > 100 * FRAMES


def place(vehicle: Vehicle, world: World, rng: np.random.Generator) -> None:
    """Put the vehicle at a random place outside every box, at a random attitude."""
    low, high = world.bounds[0] + (0.0, 0.0, 0.3), world.bounds[1]
    at = rng.uniform(low, high)
    while any(inside(at, box, -0.3) for box in world.obstacles):
        at = rng.uniform(low, high)
    attitude = rng.standard_normal(4)
    vehicle.data.qpos[:3], vehicle.data.qpos[3:7] = at, attitude / np.linalg.norm(attitude)
    mujoco.mj_forward(vehicle.model, vehicle.data)


def grown(boxes: NDArray[np.float64], by: float) -> NDArray[np.float64]:
    return boxes + by * np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])


def cast(
    origin: NDArray[np.float64], rays: NDArray[np.float64], boxes: NDArray[np.float64], ground: float
) -> NDArray[np.float64]:
    """In units of each ray, how far from ``origin`` it meets a box or the ground; ``inf`` if it does not."""
    with np.errstate(divide="ignore", invalid="ignore"):
        down = (ground - origin[2]) / rays[:, 2]
        nearest = np.where(down > 0, down, np.inf)
        for box in boxes:
            entries, exits = (box[:3] - origin) / rays, (box[3:] - origin) / rays
            first = np.minimum(entries, exits).max(axis=1)
            last = np.maximum(entries, exits).min(axis=1)
            nearest = np.where((first <= last) & (first > 0), np.minimum(nearest, first), nearest)
    return np.asarray(nearest)


def test_noise_at_the_ends_of_the_range() -> None:
    """What is measured beyond the range is no return; what is measured at or below zero is too close."""
    ahead = Vehicle(world_with((8.0, -90.0, 0.0, 9.0, 90.0, 80.0), start=(0.0, 0.0, 40.0)), AIRSIM)
    ends = DepthCamera(Camera(noise_per_m=0.1, range_m=8.1, quantisation_m=0.0), 0).render(ahead)
    measured = DepthCamera(Camera(noise_per_m=0.1, range_m=200.0, quantisation_m=0.0), 0).render(ahead)
    within = (measured > 0.0) & (measured <= 8.1)
    assert np.array_equal(ends[within], measured[within]), "the range changes no other pixel's noise"
    assert np.isposinf(ends[measured > 8.1]).all()
    assert np.isneginf(ends[np.isneginf(measured)]).all()
    assert min(np.isposinf(ends).sum(), np.isneginf(ends).sum(), within.sum()) > 100


def test_what_is_nearer_than_half_a_step_is_too_close_and_not_free() -> None:
    wall = Vehicle(world_with((0.4, -90.0, 0.0, 9.0, 90.0, 80.0), start=(0.0, 0.0, 40.0)), AIRSIM)
    assert np.isneginf(camera(quantisation_m=1.0).render(wall)).all()
