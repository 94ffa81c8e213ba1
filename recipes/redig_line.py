"""ReDiG for a line: :mod:`redig_wedge` with another default formation; run ``python recipes/redig_line.py``."""

import tyro
from config import Config
from redig_wedge import train

if __name__ == "__main__":
    train(tyro.cli(Config, default=Config(formation="line")))
