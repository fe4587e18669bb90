"""The control stage of pursuit.cpp in Python: it flies towards a point that lies a little ahead."""

import math
import struct
import sys
from bisect import bisect_left
from collections.abc import Iterator

FIELDS = 12  # of a row of the trajectory: t, x y z, vx vy vz, ax ay az, yaw, blocking_yaw
AHEAD_S, SPEED_LIMIT_M_S, TURN_1_S = 0.6, 3.0, 2.0

Step = tuple[int, list[tuple[float, ...]], tuple[float, ...]]


def aligned(at: int, size: int) -> int:
    """The next place for a number: CDR has each at a multiple of its size behind four bytes of its own."""
    return 4 + (at - 4 + size - 1) // size * size


def after_header(message: bytes) -> int:
    """The place behind a std_msgs/Header: a time and a name."""
    return 16 + struct.unpack_from("<I", message, 12)[0]


def pose(message: bytes) -> tuple[float, ...]:
    """Position x y z and attitude qx qy qz qw of a nav_msgs/Odometry."""
    name = aligned(after_header(message), 4)
    numbers = aligned(name + 4 + struct.unpack_from("<I", message, name)[0], 8)
    return struct.unpack_from("<7d", message, numbers)


def rows(message: bytes) -> list[tuple[float, ...]]:
    """The points of a zenfi_msgs/Trajectory."""
    count = aligned(aligned(after_header(message), 4) + 9, 4)
    (numbers,) = struct.unpack_from("<I", message, count)
    points = struct.unpack_from(f"<{numbers}d", message, aligned(count + 4, 8))
    return [points[begin : begin + FIELDS] for begin in range(0, numbers, FIELDS)]


def pursue(step: Step) -> bytes:
    """The velocity that leads to where the trajectory is in a moment, as a geometry_msgs/TwistStamped."""
    now_ns, plan, here = step
    vx = vy = vz = turn = 0.0
    if plan:
        target = plan[min(bisect_left(plan, (now_ns / 1e9 + AHEAD_S,)), len(plan) - 1)]
        vx, vy, vz = ((target[axis + 1] - here[axis]) / AHEAD_S for axis in range(3))
        slower = SPEED_LIMIT_M_S / max(math.hypot(vx, vy, vz), SPEED_LIMIT_M_S)
        vx, vy, vz = vx * slower, vy * slower, vz * slower
        qx, qy, qz, qw = here[3:]
        yaw = math.atan2(2 * (qx * qy + qw * qz), 1 - 2 * (qy * qy + qz * qz))
        turn = TURN_1_S * math.remainder(target[10] - yaw, 2 * math.pi)
    seconds, nanoseconds = divmod(now_ns, 1_000_000_000)
    head = struct.pack("<4siII4s", b"\0\1\0\0", seconds, nanoseconds, 4, b"map\0")
    return head + struct.pack("<6d", vx, vy, vz, 0.0, 0.0, turn)


def steps() -> Iterator[Step]:
    """What ZenFI says, up to each step."""
    plan: list[tuple[float, ...]] = []
    here: tuple[float, ...] = ()
    while words := sys.stdin.buffer.readline().split():
        body = sys.stdin.buffer.read(int(words[-1])) if words[0] != b"step" else b""
        if words[0] == b"zenfi":
            say(b"ready\n")
        elif words[0] == b"step":
            yield int(words[1]), plan, here
        elif words[1] == b"odometry":
            here = pose(body)
        else:
            plan = rows(body)


def say(answer: bytes) -> None:
    """Answer at once, not when a buffer is full."""
    sys.stdout.buffer.write(answer)
    sys.stdout.buffer.flush()


# The interpreter's loop runs Python code that C code calls in a call of its own: so map() calls pursue().
for command in map(pursue, steps()):
    say(b"put command %d\n%bdone\n" % (len(command), command))
