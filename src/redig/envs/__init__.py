"""Environments: formations, maps, rewards and the VMAS scenario made of them."""

from redig.envs.action_check import ActionCheck
from redig.envs.factory import make_env
from redig.envs.formations import FORMATIONS, formation_integrity, formation_offsets, pairwise_distances
from redig.envs.maps import ObstacleMap, corridor
from redig.envs.navigation import FormationNavigation

__all__ = [
    "FORMATIONS",
    "ActionCheck",
    "FormationNavigation",
    "ObstacleMap",
    "corridor",
    "formation_integrity",
    "formation_offsets",
    "make_env",
    "pairwise_distances",
]
