"""Physics: the same task with wheels, inertia, friction and contacts, in MuJoCo (``pip install 'redig[mujoco]'``)."""

from redig.physics.model import Ground, RobotBody, team_model
from redig.physics.navigation import PhysicsNavigation, base_of
from redig.physics.world import PhysicsWorld

__all__ = ["Ground", "PhysicsNavigation", "PhysicsWorld", "RobotBody", "base_of", "team_model"]
