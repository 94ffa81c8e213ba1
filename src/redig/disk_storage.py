"""A replay buffer on disk that a checkpoint need not copy, and that still comes back as the checkpoint left it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyMemmapStorage

from redig.files import replacing


class DiskStorage(LazyMemmapStorage):
    """Memory-mapped storage whose state is a position; the entries stay in their files.

    TorchRL's own storage either copies all entries into a checkpoint, or leaves them in place, where a run that goes on
    overwrites the oldest of them once the buffer is full: after a crash, the entries that the checkpoint knew would be
    gone. This one keeps a copy on disk of what has been overwritten since the checkpoint before the last, and
    :meth:`load_state_dict` puts it back. So a run can be killed at any moment, and continues with the very entries of
    its last checkpoint. (Not with ``set_at_``, which changes entries behind the back of the storage.)

    Args:
        max_size: capacity.
        folder: of the files; new ones replace those of a run that never reached a checkpoint.

    Examples:
        >>> import tempfile
        >>> from torchrl.data import TensorDictReplayBuffer
        >>> folder = tempfile.TemporaryDirectory()
        >>> buffer = TensorDictReplayBuffer(storage=DiskStorage(3, folder.name))
        >>> _ = buffer.extend(TensorDict({"reward": torch.arange(3.0)}, [3]))
        >>> state = buffer.storage.state_dict()
        >>> _ = buffer.extend(TensorDict({"reward": torch.full((2,), 9.0)}, [2]))  # and here the run is killed
        >>> storage = DiskStorage(3, folder.name)
        >>> storage.load_state_dict(state)
        >>> storage[:]["reward"].tolist()
        [0.0, 1.0, 2.0]
        >>> folder.cleanup()
    """

    def __init__(self, max_size: int, folder: str | Path) -> None:
        self.entries, self.overwritten = Path(folder) / "entries", Path(folder) / "overwritten"
        super().__init__(max_size, scratch_dir=self.entries, existsok=True)
        self._writes = 0
        self._saved: int | None = None  # writes at the last checkpoint

    def set(self, cursor: Any, data: TensorDictBase, *, set_cursor: bool = True) -> None:
        """Write entries; what they replace is kept until the next checkpoint but one."""
        slots = torch.as_tensor(cursor).reshape(-1)
        slots = slots[slots < len(self)]
        if self._saved is not None and len(slots):
            with replacing(self.overwritten / f"{self._writes:012d}.pt") as file:
                torch.save({"slots": slots, "entries": self._storage[slots].flatten_keys("/").to_dict()}, file)
        self._writes += 1
        super().set(cursor, data, set_cursor=set_cursor)

    def state_dict(self) -> dict[str, int]:
        """Where the storage stands, once all entries have reached the disk."""
        self._flush()
        for write, file in self._kept():  # the checkpoint after which these were kept is not the last one any more
            if write < (self._saved or 0):
                file.unlink()
        self._saved = self._writes
        return {"size": len(self), "writes": self._writes}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Bring the files of the folder back to where :meth:`state_dict` found them.

        Raises:
            FileNotFoundError: if they are not there.
        """
        if state_dict["size"]:
            if not (self.entries / "meta.json").is_file():
                raise FileNotFoundError(f"buffer: no entries in {self.entries}; it was moved or deleted")
            self._storage, self.initialized = TensorDict.load_memmap(self.entries), True
            for write, file in reversed(self._kept()):
                if write >= state_dict["writes"]:
                    kept = torch.load(file, weights_only=True)
                    self._storage[kept["slots"]] = TensorDict(kept["entries"], kept["slots"].shape).unflatten_keys("/")
            self._flush()
        for _, file in self._kept():
            file.unlink()
        self._len = state_dict["size"]
        self._writes = self._saved = state_dict["writes"]

    def _kept(self) -> list[tuple[int, Path]]:
        """Files of overwritten entries with the numbers of the writes, oldest first."""
        return sorted((int(file.stem), file) for file in self.overwritten.glob("[0-9]*.pt"))

    def _flush(self) -> None:
        for path in self.entries.rglob("*.memmap"):
            with open(path, "rb") as file:
                os.fsync(file.fileno())
