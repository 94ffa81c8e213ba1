"""Which robots hear each other: as a matrix, for small teams, and as a list of edges, for large ones."""

from __future__ import annotations

import torch
from torch import Tensor

CELLS = 2**13  # along an axis; robots beyond them count as being in the outermost
COLUMN = CELLS + 1  # one cell stays empty, so that the next column, or the next team, is nobody's neighbour


def radius_adjacency(position: Tensor, radius: float) -> Tensor:
    """Which robots hear each other, without self-loops: ``[*B, n, 2]`` (m) to a boolean ``[*B, n, n]``.

    Distances are taken in float32 or better.

    Raises:
        ValueError: if ``position`` has another rank.

    Examples:
        >>> import torch
        >>> radius_adjacency(torch.tensor([[0.0, 0.0], [1.0, 0.0], [9.0, 0.0]]), 2.0).sum().item()
        2
    """
    position = _checked(position)
    near = within(position.unsqueeze(-3) - position.unsqueeze(-2), radius)
    return near & ~torch.eye(position.shape[-2], dtype=torch.bool, device=position.device)


@torch.no_grad()
def radius_edges(position: Tensor, radius: float) -> Tensor:
    """The same as a list of edges, without looking at all pairs: ``[*B, n, 2]`` (m) to ``edge_index`` ``[2, E]``.

    Teams are sorted into square cells a little wider than the radius, so that a robot's neighbours are in its own cell
    and the eight around it. Time and memory grow with the number of pairs in such cells: in proportion to the number of
    robots at constant density, with its square where all crowd together or are thousands of radii away from their team.

    Args:
        position: of all robots of all teams (m); distances are taken in float32 or better.
        radius: communication range (m), itself included.

    Returns:
        ``[2, E]`` of type int64, from neighbour (row 0) to robot (row 1), as PyTorch Geometric has it, sorted by robot;
        robot ``i`` of team ``b`` has the number ``b * n + i``. The number of edges depends on the data, so
        ``torch.compile`` and ``torch.export`` cannot make it a part of one graph.

    Raises:
        ValueError: if ``position`` has another rank.

    Examples:
        >>> import torch
        >>> teams = torch.tensor([[[0.0, 0.0], [1.0, 0.0]], [[0.0, 0.0], [9.0, 0.0]]])
        >>> radius_edges(teams, 2.0)  # in the second team, nobody hears anybody
        tensor([[1, 0],
                [0, 1]])
    """
    position = _checked(position)
    cell = _cells(position, radius)
    position = position.reshape(-1, 2)
    order = cell.argsort()
    ordered = cell[order]
    columns = cell.unsqueeze(-1) + COLUMN * torch.arange(-1, 2, device=cell.device)  # left, own, right: [N, 3]
    # the three cells of a column follow one another, so their robots are one run of the sorted ones
    first = torch.searchsorted(ordered, columns - 1).flatten()
    count = torch.searchsorted(ordered, columns + 1, right=True).flatten() - first
    run = torch.repeat_interleave(count)
    place = torch.arange(len(run), device=cell.device) - (count.cumsum(0) - count)[run]
    robot, other = run // 3, order[first[run] + place]
    near = within(position[other] - position[robot], radius) & (other != robot)
    return torch.stack([other[near], robot[near]])


def within(offset: Tensor, radius: float) -> Tensor:
    """Whether offsets ``[*B, 2]`` (m) are at most ``radius`` long: ``[*B]``.

    Squares, a sum of two and a root, each rounded by itself: an offset gets the same answer in every layout, which
    ``norm`` and ``cdist`` do not promise.

    Examples:
        >>> import torch
        >>> within(torch.tensor([[3.0, 4.0], [3.0, 4.1]]), 5.0)
        tensor([ True, False])
    """
    return offset.square().sum(-1).sqrt() <= radius


def at_least_float32(position: Tensor) -> Tensor:
    """Positions in a type that does not blur distances.

    Examples:
        >>> import torch
        >>> at_least_float32(torch.zeros(2, dtype=torch.bfloat16)).dtype
        torch.float32
    """
    return position.to(torch.promote_types(position.dtype, torch.float32))


def _checked(position: Tensor) -> Tensor:
    if position.ndim < 2:
        raise ValueError(f"position: got shape {list(position.shape)}, expected [*B, n, 2]")
    return at_least_float32(position)


def _cells(position: Tensor, radius: float) -> Tensor:
    """Number of each robot's cell, ``[N]``: cells of a column are consecutive, then columns, then teams.

    Within ``CELLS / 2`` cells of the team's median, rounding moves a robot by less than a 1000th of a cell, even in
    float32; as cells are 1 % wider than the radius, no two neighbours are more than one cell apart. Robots beyond share
    the outermost cells: slow, but nothing is missed. One whose position is not a number has no neighbours anyway.
    """
    half = CELLS // 2
    middle = position.nanmedian(-2, keepdim=True).values if position.numel() else position
    x, y = ((position - middle) / (1.01 * radius)).nan_to_num().clamp(-half, half - 1).floor().long().unbind(-1)
    team = torch.arange(x.numel(), device=x.device).reshape(x.shape) // max(x.shape[-1], 1)
    return ((team * COLUMN + x) * COLUMN + y).flatten()
