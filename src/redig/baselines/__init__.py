"""Baselines: what the diffusion policy is compared with. Some learn (PPO), some plan with the map and all goals."""

from redig.baselines.leader_follower import LeaderFollower
from redig.baselines.ppo_gnn import gaussian_policy, state_value
from redig.baselines.uncoordinated import UncoordinatedPlanner
from redig.baselines.virtual_structure import VirtualStructure

__all__ = ["LeaderFollower", "UncoordinatedPlanner", "VirtualStructure", "gaussian_policy", "state_value"]
