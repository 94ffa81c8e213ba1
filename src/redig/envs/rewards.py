"""Rewards as pure functions of position and velocity: Eq. 29 and 30 as printed, and the variants that train.

Every function takes a team at once. Positions are in m, velocities in m/s, one reward a robot (or one a team where the
paper has one a team), in the paper's units before any reward scaling.
"""

from __future__ import annotations

import torch
from torch import Tensor

from redig.envs.formations import formation_integrity, pairwise_distances


def spring_damper(position: Tensor, velocity: Tensor, desired: Tensor, omega: float = 0.5) -> Tensor:
    """Spring-damper reward of the team, Eq. 29 as printed: the sum over all pairs, unbounded and never positive.

    ``R = sum_{i,j} -omega |d_ij - p_ij| - (1 - omega) q_ij``; both orders of a pair are counted, as in the paper.

    Args:
        position: ``[*B, n, 2]`` (m).
        velocity: ``[*B, n, 2]`` (m/s).
        desired: desired distances d_ij ``[n, n]`` (m).
        omega: balance of spring and damper, in [0, 1].

    Returns:
        reward ``[*B]``, the same for every robot of the team.

    Examples:
        >>> import torch
        >>> line = torch.tensor([[0.0, 0.0], [1.0, 0.0]])
        >>> spring_damper(line, torch.zeros(2, 2), 2 * torch.ones(2, 2) - 2 * torch.eye(2)).item()
        -1.0
    """
    spring = (desired - pairwise_distances(position)).abs()
    damper = pairwise_distances(velocity)
    return -(omega * spring + (1 - omega) * damper).sum((-2, -1))


def spring_damper_bonus(
    position: Tensor, velocity: Tensor, desired: Tensor, omega: float = 0.8, clip: float = 1.0
) -> Tensor:
    """Eq. 29 as a bonus: the mean over teammates, clipped and offset, so that staying alive is never a loss.

    ``mean_j (1 - min(|d_ij - p_ij|, clip) / clip) - (1 - omega) / omega * q_ij``; the ratio of spring to damper is the
    paper's, and the default 0.8 gives the damper a quarter of the spring's weight.

    Args:
        position: ``[*B, n, 2]`` (m).
        velocity: ``[*B, n, 2]`` (m/s).
        desired: ``[n, n]`` (m).
        omega: balance of spring and damper, in (0, 1].
        clip: error of a distance (m) from which on the bonus of a pair is 0.

    Returns:
        reward ``[*B, n]``, at most 1.

    Examples:
        >>> import torch
        >>> line = torch.tensor([[0.0, 0.0], [0.5, 0.0]])
        >>> spring_damper_bonus(line, torch.zeros(2, 2), 2 * torch.ones(2, 2))  # 1.5 m from the desired distance
        tensor([0., 0.])
        >>> spring_damper_bonus(line, torch.zeros(2, 2), torch.ones(2, 2))
        tensor([0.5000, 0.5000])
    """
    n = position.shape[-2]
    spring = 1 - (desired - pairwise_distances(position)).abs().clamp_max(clip) / clip
    damper = pairwise_distances(velocity)
    mates = 1 - torch.eye(n, dtype=position.dtype, device=position.device)
    return ((spring - (1 - omega) / omega * damper) * mates).sum(-1) / (n - 1)


def best_lateral_scale(
    position: Tensor, offsets: Tensor, direction: Tensor, limits: tuple[float, float] = (0.3, 1.1)
) -> tuple[Tensor, Tensor]:
    """The lateral scaling of a formation that fits a team best, and how far each robot is from its scaled place.

    With ``f`` the formation's offsets and ``q`` the team's, both from their centroids in the frame of travel,
    ``s = sum f_y q_y / sum f_y^2``, clamped.

    Args:
        position: ``[*B, n, 2]`` (m).
        offsets: the formation ``[n, 2]`` (m), see :func:`redig.envs.formations.formation_offsets`.
        direction: unit vector of travel ``[*B, 2]``, so that the corridor may point anywhere.
        limits: smallest and largest scale.

    Returns:
        scale ``[*B]`` and residual ``[*B, n]`` (m), measured after stretching the team back to full width, so that a
        formation squeezed to a third must be kept three times as precisely across, as its proportions demand.

    Examples:
        >>> import torch
        >>> from redig.envs.formations import formation_offsets
        >>> line = formation_offsets("line", 3)
        >>> scale, residual = best_lateral_scale(0.5 * line, line, torch.tensor([1.0, 0.0]))
        >>> scale.item(), residual.max().item()  # half as broad, and whole
        (0.5, 0.0)
    """
    relative = position - position.mean(-2, keepdim=True)
    direction = direction.unsqueeze(-2)
    forward = (relative * direction).sum(-1)
    left = relative[..., 1] * direction[..., 0] - relative[..., 0] * direction[..., 1]
    scale = (left * offsets[:, 1]).sum(-1) / offsets[:, 1].square().sum()
    scale = scale.clamp(*limits)
    error = torch.stack([forward - offsets[:, 0], left / scale.unsqueeze(-1) - offsets[:, 1]], -1)
    return scale, error.norm(dim=-1)


def scaled_formation_bonus(
    position: Tensor,
    offsets: Tensor,
    direction: Tensor,
    tolerance: float = 0.5,
    squeeze_cost: float = 0.5,
    limits: tuple[float, float] = (0.3, 1.1),
) -> Tensor:
    """Formation against the best lateral scaling of the shape: a squeezed formation counts as whole, and costs little.

    ``1 - min(residual_i / tolerance, 1) - squeeze_cost * max(1 - s, 0)``, see :func:`best_lateral_scale`. The spring
    term compares absolute distances while the CFI compares proportions; inside a corridor the two disagree, and
    this form sides with the CFI.

    Args:
        position: ``[*B, n, 2]`` (m).
        offsets: the formation ``[n, 2]`` (m).
        direction: unit vector of travel ``[*B, 2]``.
        tolerance: residual (m) at which a robot's bonus is gone.
        squeeze_cost: price of a formation squeezed to nothing; it makes the team spread again behind the corridor.
        limits: smallest and largest lateral scale.

    Returns:
        reward ``[*B, n]``, at most 1.

    Examples:
        >>> import torch
        >>> from redig.envs.formations import formation_offsets
        >>> wedge = formation_offsets("wedge", 5)
        >>> scaled_formation_bonus(wedge, wedge, torch.tensor([1.0, 0.0])).round(decimals=4)
        tensor([1., 1., 1., 1., 1.])
    """
    scale, residual = best_lateral_scale(position, offsets, direction, limits)
    return 1 - (residual / tolerance).clamp_max(1) - squeeze_cost * (1 - scale).clamp_min(0).unsqueeze(-1)


def slanted_formation_bonus(
    position: Tensor,
    offsets: Tensor,
    direction: Tensor,
    tolerance: float = 0.5,
    slant_cost: float = 0.1,
    steepest: float = 1.5,
) -> Tensor:
    """:func:`scaled_formation_bonus` for a shape that may also lean, such as a line, which stays a line.

    The slant ``k = sum f_y q_x / sum f_y^2``, clamped, is by how much the team's left is ahead of its right (m a metre
    of the full formation). It is taken out before the scale is fitted, at ``slant_cost * |k|``. Robots abreast that are
    too broad for a gap side by side pass it in echelon, in proportion all the way; a wedge that leans is none.

    Args:
        position: ``[*B, n, 2]`` (m).
        offsets: the formation ``[n, 2]`` (m).
        direction: unit vector of travel ``[*B, 2]``.
        tolerance: residual (m) at which a robot's bonus is gone.
        slant_cost: price of a slant of one; it makes the team straighten up again.
        steepest: largest slant, to either side.

    Returns:
        reward ``[*B, n]``, at most 1.

    Examples:
        >>> import torch
        >>> from redig.envs.formations import formation_offsets
        >>> line = formation_offsets("line", 5)
        >>> echelon = torch.stack([0.5 * line[:, 1], line[:, 1]], -1)  # turned by 27 degrees
        >>> slanted_formation_bonus(echelon, line, torch.tensor([1.0, 0.0])).round(decimals=4)
        tensor([0.9500, 0.9500, 0.9500, 0.9500, 0.9500])
    """
    forward = (position * direction.unsqueeze(-2)).sum(-1)
    slant = ((forward * offsets[:, 1]).sum(-1) / offsets[:, 1].square().sum()).clamp(-steepest, steepest).unsqueeze(-1)
    upright = position - (slant * offsets[:, 1]).unsqueeze(-1) * direction.unsqueeze(-2)
    return scaled_formation_bonus(upright, offsets, direction, tolerance) - slant_cost * slant.abs()


def integrity_bonus(
    name: str, position: Tensor, offsets: Tensor, direction: Tensor, squeeze_cost: float = 0.1
) -> Tensor:
    """Tau of the contextual formation integrity, the measure of the evaluation, as a reward of the team.

    ``tau - squeeze_cost * max(1 - s, 0)`` with the lateral scale s of :func:`best_lateral_scale`. Whatever keeps the
    proportions is as good as any other: a circle that is squeezed and stretched, a line that leans.

    Args:
        name: of the formation, see :func:`redig.envs.formations.formation_integrity`.
        position: ``[*B, n, 2]`` (m).
        offsets: the formation ``[n, 2]`` (m).
        direction: unit vector of travel ``[*B, 2]``.
        squeeze_cost: price of a formation squeezed to nothing; it makes the team spread again behind the corridor.

    Returns:
        reward ``[*B]``, at most 1, the same for every robot of the team.

    Examples:
        >>> import torch
        >>> from redig.envs.formations import formation_offsets
        >>> line = formation_offsets("line", 5)
        >>> echelon = torch.stack([0.5 * line[:, 1], 0.8 * line[:, 1]], -1)  # it leans, and is less broad
        >>> integrity_bonus("line", echelon, line, torch.tensor([1.0, 0.0])).round(decimals=4)
        tensor(0.9800)
    """
    scale, _ = best_lateral_scale(position, offsets, direction)
    return formation_integrity(name, position) - squeeze_cost * (1 - scale).clamp_min(0)


def goal_speed(position: Tensor, velocity: Tensor, goal: Tensor) -> Tensor:
    """The moving part of Eq. 30, ``q . r / |r| * |q|``: speed times its alignment with the goal. ``[*B, n]``.

    Examples:
        >>> import torch
        >>> velocity = torch.tensor([[0.5, 0.0], [0.0, 0.5]])  # towards the goal, and across
        >>> goal_speed(torch.zeros(2, 2), velocity, torch.tensor([3.0, 0.0]))
        tensor([0.2500, 0.0000])
    """
    to_goal = goal - position
    heading = to_goal / to_goal.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    return (velocity * heading).sum(-1) * velocity.norm(dim=-1)


def progress(previous_position: Tensor, position: Tensor, goal: Tensor, dt: float) -> Tensor:
    """Speed at which the goal comes nearer (m/s), ``[*B, n]``: the form of navigation reward that trains best.

    Examples:
        >>> import torch
        >>> origin = torch.zeros(1, 2)
        >>> progress(origin, origin + 0.1, torch.tensor([[3.0, 3.0]]), dt=0.1).item() > 1.4
        True
    """
    return ((goal - previous_position).norm(dim=-1) - (goal - position).norm(dim=-1)) / dt


def clearance(position: Tensor, obstacle_distance: Tensor, radius: float) -> Tensor:
    """Free space around each robot (m): to the nearest wall or teammate, 0 at contact.

    Args:
        position: ``[*B, n, 2]`` (m).
        obstacle_distance: signed distance of the robot's centre to the nearest obstacle ``[*B, n]`` (m).
        radius: of a robot (m).

    Returns:
        ``[*B, n]`` (m); negative where robots overlap or stand inside a wall, which is a collision of either kind.

    Examples:
        >>> import torch
        >>> position = torch.tensor([[0.0, 0.0], [1.0, 0.0]])
        >>> clearance(position, torch.tensor([3.0, 0.5]), radius=0.25)  # the mate is nearer, the wall is nearer
        tensor([0.5000, 0.2500])
    """
    return torch.minimum(mate_clearance(position, radius), obstacle_distance - radius)


def mate_clearance(position: Tensor, radius: float) -> Tensor:
    """Free space between each robot ``[*B, n, 2]`` (m) and the nearest teammate: ``[*B, n]`` (m), 0 at contact.

    Examples:
        >>> import torch
        >>> mate_clearance(torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 3.0]]), radius=0.25)
        tensor([0.5000, 0.5000, 2.5000])
    """
    myself = torch.eye(position.shape[-2], dtype=torch.bool, device=position.device)
    return pairwise_distances(position).masked_fill(myself, float("inf")).amin(-1) - 2 * radius


def proximity(clearance: Tensor, margin: float = 0.1) -> Tensor:
    """Ramp that warns of a collision: 0 with ``margin`` (m) or more of free space, 1 at contact. ``[*B, n]``.

    Examples:
        >>> import torch
        >>> proximity(torch.tensor([1.0, 0.125, 0.0]), margin=0.25)
        tensor([0.0000, 0.5000, 1.0000])
    """
    return (1 - clearance / margin).clamp(0, 1)
