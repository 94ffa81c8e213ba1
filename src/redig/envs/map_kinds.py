"""The kinds of maps that the paper's teams cross (its Figs. 4, 5 and 10 to 12), beside the straight corridor.

Each has a route, whose ends leave a formation 2 m broad room to start and to stop. ``gap`` is the narrowest passage.
"""

from __future__ import annotations

import math
import random
from itertools import combinations

import torch

from redig.envs.maps import ObstacleMap, check_positive

Box = tuple[float, float, float, float, float, float]
Point = tuple[float, float]
Trunk = tuple[float, float, float]  # x, y, radius
MARGIN = 2.5  # (m) around the route, for planners
WALL = 3.0  # (m) walls are longer than the margin, so that no way leads around them


def narrowing(gap: float = 0.9, entrance: float = 2.4, length: float = 3.0, approach: float = 1.75) -> ObstacleMap:
    """A corridor that narrows evenly, as between two buildings (Fig. 10b).

    Args:
        gap: breadth of its exit (m).
        entrance: breadth of its entrance (m), more than the gap.
        length: of the corridor (m).
        approach: from the centre of the start formation to the entrance, and from the exit to the goal (m).

    Raises:
        ValueError: if a size is not positive, or the entrance not broader than the gap.

    Examples:
        >>> exit = torch.tensor([1.5, 0.0])
        >>> round(narrowing(gap=0.9, length=3.0).signed_distance(exit).item(), 4)
        0.45
    """
    check_positive(gap=gap, entrance=entrance, length=length, approach=approach)
    if not entrance > gap:
        raise ValueError(f"entrance: got {entrance}, must be greater than gap = {gap} m")
    slope = math.atan2((entrance - gap) / 2, length)
    face = length / math.cos(slope)
    # from the middle of the face into the wall
    x, y = WALL / 2 * math.sin(slope), (entrance + gap) / 4 + WALL / 2 * math.cos(slope)
    boxes = [(x, side * y, face / 2, WALL / 2, -side * slope, 0.0) for side in (1, -1)]
    return with_route(boxes, gap, _straight(length / 2 + approach))


def passages(
    gap: float = 1.0,
    count: int = 3,
    length: float = 0.5,
    spacing: float = 2.0,
    shift: float = 0.3,
    approach: float = 1.75,
) -> ObstacleMap:
    """Several narrow passages in a row, alternately to the left and to the right of the middle (Fig. 10a).

    Args:
        gap: breadth of each passage (m).
        count: number of passages.
        length: of a passage: the thickness of its wall (m).
        spacing: between two walls (m).
        shift: of the passages from the middle (m).
        approach: from the centre of the start formation to the first wall, and from the last one to the goal (m).

    Raises:
        ValueError: if a size is not positive, the shift negative, the count less than 1 or the spacing than the gap.

    Examples:
        >>> row = passages(count=2, spacing=2.0, shift=0.25)
        >>> len(row.obstacles), row.route[1].tolist()  # two walls, each in two parts; the first passage's entrance
        (4, [-1.5, 0.25])
    """
    check_positive(gap=gap, length=length, spacing=spacing, approach=approach)
    if count < 1:
        raise ValueError(f"count: got {count}, must be at least 1")
    if not shift >= 0:
        raise ValueError(f"shift: got {shift}, must not be negative (m)")
    if spacing < gap:
        raise ValueError(f"spacing: got {spacing}, must be at least gap = {gap} m, the narrowest passage")
    first = -(count - 1) / 2 * (length + spacing)
    places = [(first + i * (length + spacing), shift * (-1) ** i) for i in range(count)]
    wall = WALL + 2 * shift
    boxes = [(x, y + side * (gap + wall) / 2, length / 2, wall / 2, 0.0, 0.0) for x, y in places for side in (1, -1)]
    route = [(x + end * length / 2, y) for x, y in places for end in (-1, 1)]
    start, goal = (route[0][0] - approach, route[0][1]), (route[-1][0] + approach, route[-1][1])
    return with_route(boxes, gap, [start, *route, goal])


def curve(
    gap: float = 1.1,
    radius: float = 3.5,
    turn: float = math.pi / 2,
    approach: float = 1.75,
    piece: float = math.pi / 16,
) -> ObstacleMap:
    """A long curved pathway between walls (Sec. 4, Fig. 4): short straight pieces around an arc, open at its ends.

    The start and the goal formation lie on the x axis, and head along the path.

    Args:
        gap: breadth of the pathway (m).
        radius: of its middle line (m), more than half the gap.
        turn: angle of the arc (rad), within ±3; positive to the left.
        approach: from the centre of the start formation to the pathway, and from its end to the goal (m).
        piece: largest angle of a piece (rad).

    Raises:
        ValueError: if a size is not positive, the turn 0 or beyond its limits, or the radius too small.

    Examples:
        >>> left = curve(radius=3.0, turn=1.2).route
        >>> left[:2]  # 1.75 m straight on, down and to the right
        tensor([[-3.1445,  0.0000],
                [-1.7002, -0.9881]])
    """
    check_positive(gap=gap, radius=radius, approach=approach, piece=piece)
    if not 0 < abs(turn) <= 3:
        raise ValueError(f"turn: got {turn}, must not be 0 and be within ±3 rad")
    if not radius > gap / 2:
        raise ValueError(f"radius: got {radius}, must be greater than half the gap, {gap / 2} m")
    side, angle = math.copysign(1.0, turn), abs(turn)
    count = math.ceil(angle / piece - 1e-9)
    half = angle / count / 2  # of a piece
    inner, outer, middle, thick = radius - gap / 2, radius + gap / 2, radius / math.cos(half), 0.5
    centre = middle * math.cos(angle / 2) - approach * math.sin(angle / 2)  # of the arc, on the y axis

    def at(heading: float, distance: float, along: float = 0.0) -> Point:
        """The point ``distance`` from the centre where the path has a heading, and ``along`` that heading from it."""
        x, y = distance * math.sin(heading), centre - distance * math.cos(heading)
        return x + along * math.cos(heading), side * (y + along * math.sin(heading))

    boxes: list[Box] = []
    for i in range(count):
        heading = -angle / 2 + (2 * i + 1) * half
        tilt = side * heading
        boxes.append((*at(heading, inner / 2), inner * math.tan(half), inner / 2, tilt, 0.0))
        boxes.append((*at(heading, outer + thick / 2), (outer + thick) * math.tan(half), thick / 2, tilt, 0.0))
    for end in (-1, 1):  # a wall across, outside the path, at either end
        heading = end * angle / 2
        place = at(heading, outer / math.cos(half) + WALL, -end * thick / 2)
        boxes.append((*place, thick / 2, WALL, side * heading, 0.0))
    away = WALL + max(0.0, -centre)  # and one that closes the way around the inner side
    boxes.append((0.0, side * (centre + away / 2), thick / 2, away / 2, 0.0, 0.0))
    route = [at(-angle / 2 + 2 * i * half, middle) for i in range(count + 1)]
    start, goal = at(-angle / 2, middle, -approach), at(angle / 2, middle, approach)
    return with_route(boxes, gap, [start, *route, goal])


def bollards(gap: float = 1.0, radius: float = 0.3, approach: float = 1.75) -> ObstacleMap:
    """Two round bollards on open ground (Fig. 12a and c); a robot may also pass outside.

    Args:
        gap: between the bollards (m).
        radius: of a bollard (m).
        approach: from the centre of the start formation to the bollards, and from them to the goal (m).

    Raises:
        ValueError: if a size is not positive.

    Examples:
        >>> bollards(gap=1.0).signed_distance(torch.zeros(2)).item()
        0.5
    """
    check_positive(gap=gap, radius=radius, approach=approach)
    boxes = [(0.0, side * (gap / 2 + radius), 0.0, 0.0, 0.0, radius) for side in (1, -1)]
    return with_route(boxes, gap, _straight(radius + approach))


def forest(
    gap: float = 0.8,
    count: int = 12,
    trunk: tuple[float, float] = (0.1, 0.3),
    length: float = 3.5,
    breadth: float = 4.5,
    approach: float = 1.75,
    seed: int = 0,
) -> ObstacleMap:
    """Round trunks at random places, none closer to another than ``gap`` (Fig. 12b).

    Trunks are put up until there are ``count`` or a thousand places in a row are too close to those that stand. The
    map's own ``gap`` is the narrowest passage between two trunks that came of it.

    Args:
        gap: least free space between two trunks (m).
        count: number of trunks at most.
        trunk: least and greatest radius of a trunk (m).
        length: of the forest, along the way (m).
        breadth: of the forest (m).
        approach: from the centre of the start formation to the forest, and from the forest to the goal (m).
        seed: of the trunks.

    Raises:
        ValueError: if a size is not positive, the count less than 2, or the forest too small for two trunks.

    Examples:
        >>> wood = forest(gap=0.8, count=6)
        >>> len(wood.obstacles), wood.gap >= 0.8
        (6, True)
    """
    low, high = trunk
    check_positive(gap=gap, length=length, breadth=breadth, approach=approach, trunk=low)
    if count < 2:
        raise ValueError(f"count: got {count}, must be at least 2")
    if not low <= high < min(length, breadth) / 2:
        raise ValueError(f"trunk: got {trunk}, must be the least radius and the greatest, which fits into the forest")
    generator = random.Random(seed)
    trunks: list[Trunk] = []
    failures = 0
    while len(trunks) < count and failures < 1000:
        radius = generator.uniform(low, high)
        x = generator.uniform(-1, 1) * (length / 2 - radius)
        y = generator.uniform(-1, 1) * (breadth / 2 - radius)
        if all(_between((x, y, radius), other) >= gap for other in trunks):
            trunks.append((x, y, radius))
            failures = 0
        else:
            failures += 1
    if len(trunks) < 2:
        raise ValueError(f"gap: got {gap}, with which {length} m x {breadth} m of forest have no room for two trunks")
    narrowest = min(_between(one, other) for one, other in combinations(trunks, 2))
    boxes = [(x, y, 0.0, 0.0, 0.0, radius) for x, y, radius in trunks]
    return with_route(boxes, narrowest, _straight(length / 2 + approach))


def doorway(
    gap: float = 0.9, thickness: float = 0.2, hallway: float = 4.0, offset: float = 0.0, approach: float = 1.75
) -> ObstacleMap:
    """A door in a wall across a hallway (Fig. 11).

    Args:
        gap: breadth of the door (m).
        thickness: of the wall that it is in (m).
        hallway: breadth of the hallway (m).
        offset: of the hallway's middle from that of the door (m), to the left.
        approach: from the centre of the start formation to the door, and from the door to the goal (m).

    Raises:
        ValueError: if a size is not positive, or the door not within the hallway.

    Examples:
        >>> hall = doorway(gap=0.9, hallway=4.0)
        >>> hall.signed_distance(torch.tensor([[0.0, 0.0], [-1.5, 1.5]]))  # in the door, and before it near the wall
        tensor([0.4500, 0.5000])
    """
    check_positive(gap=gap, thickness=thickness, hallway=hallway, approach=approach)
    if not gap / 2 + abs(offset) < hallway / 2:
        raise ValueError(f"offset: got {offset}, with which the door of {gap} m is not within {hallway} m of hallway")
    reach, boxes = thickness / 2 + approach, []
    for side in (1, -1):
        hall = hallway / 2 + side * offset  # from the middle of the door to the wall of the hallway
        boxes.append((0.0, side * (hall + gap / 2) / 2, thickness / 2, (hall - gap / 2) / 2, 0.0, 0.0))
        boxes.append((0.0, side * (hall + 0.25), reach + MARGIN, 0.25, 0.0, 0.0))
    return with_route(boxes, gap, _straight(reach))


def _straight(reach: float) -> list[Point]:
    return [(-reach, 0.0), (reach, 0.0)]


def _between(one: Trunk, other: Trunk) -> float:
    """Free space between two trunks (m)."""
    return math.hypot(one[0] - other[0], one[1] - other[1]) - one[2] - other[2]


def with_route(boxes: list[Box], gap: float, route: list[Point]) -> ObstacleMap:
    """A map of rounded boxes whose bounds lie 2.5 m around the team's route.

    Examples:
        >>> with_route([(0.0, 0.0, 0.0, 0.0, 0.0, 0.5)], gap=1.0, route=[(-2.0, 1.0), (2.0, 1.0)]).bounds
        (-4.5, -1.5, 4.5, 3.5)
    """
    x, y = zip(*route, strict=True)
    bounds = (min(x) - MARGIN, min(y) - MARGIN, max(x) + MARGIN, max(y) + MARGIN)
    return ObstacleMap(torch.tensor(boxes), gap, bounds, torch.tensor(route))
