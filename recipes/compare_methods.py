"""The methods of the comparison: TorchRL's, and ours with the same networks, batches and updates.

To add one, write ``make_<method>(env, config) -> Method`` and name it in ``METHODS``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from compare_tasks import GYM, VMAS, Config
from diffusion_methods import make_dipo, make_dipo_paper, make_dpmd, make_qvpo
from peers import Method, make_ddpg, make_sac, make_td3
from torchrl.envs import EnvBase

Maker = Callable[[EnvBase, Config], Method]


OURS: Mapping[str, Maker] = {"dipo": make_dipo, "qvpo": make_qvpo, "dpmd": make_dpmd}
SINGLE_AGENT: Mapping[str, Maker] = {"sac": make_sac, "td3": make_td3, "dipo_paper": make_dipo_paper, **OURS}
TEAM: Mapping[str, Maker] = {
    "iddpg": partial(make_ddpg, centralised=False),
    "maddpg": partial(make_ddpg, centralised=True),
    "masac": make_sac,
    **OURS,
}
METHODS: Mapping[str, Mapping[str, Maker]] = {name: SINGLE_AGENT for name in GYM} | {name: TEAM for name in VMAS}
# what differs from the defaults of Config: chosen on seeds 100 and above, see docs/results/compare/tuning.csv
TUNED: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "pendulum": {name: {"lr": 1e-3} for name in ("sac", "td3", "dipo", "qvpo", "dpmd")},
    "navigation": {name: {"lr": 1e-3} for name in ("iddpg", "maddpg", "dipo", "qvpo", "dpmd")}
    | {"masac": {"lr": 1e-3, "alpha_init": 0.01}},
    "reverse_transport": {name: {"lr": 1e-3} for name in ("iddpg", "maddpg", "dipo", "qvpo", "dpmd")}
    | {"masac": {"lr": 1e-3, "alpha_init": 0.01}},
}
