"""ReDiG for a circle: :mod:`redig_wedge` with another default formation; run ``python recipes/redig_circle.py``."""

import tyro
from config import Config
from redig_wedge import train

if __name__ == "__main__":
    train(tyro.cli(Config, default=Config(formation="circle")))
