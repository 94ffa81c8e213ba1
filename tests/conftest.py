import os
import re

import pytest
import torch

os.environ["OMP_NUM_THREADS"] = "1"  # for the programs that tests start
torch.set_num_threads(1)

collect_ignore = ["deploy/ros1_peer.py", "deploy/ros2_peer.py"]  # programs for another Python, which has ROS


@pytest.fixture(scope="session")
def python_blocks():
    """The ```python blocks of a Markdown file, in order."""
    return lambda path: re.findall(r"^```python\n(.*?)^```", path.read_text(), re.DOTALL | re.MULTILINE)
