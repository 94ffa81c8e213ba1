"""Baselines: what the diffusion policy is compared with."""

from redig.baselines.ppo_gnn import gaussian_policy, state_value

__all__ = ["gaussian_policy", "state_value"]
