"""Both ends of a wire in memory, for a test at one of them."""

from __future__ import annotations

from drivers.links.memory_link import MemoryLink


class End(MemoryLink):
    """One end; a pair that one end has left stays apart."""

    other: End
    _left = False

    def close(self) -> None:
        """Let go of this end."""
        if not self._left:
            self._left = True
            self.unplug()
            self.other.unplug()
        super().close()

    async def open(self) -> None:
        """Take hold of this end."""
        self._left = False
        await super().open()


def pair(device: str) -> tuple[End, End]:
    """Return the two ends of a wire; must be called within a running loop."""
    near, far = End(device, lambda data: far.deliver(data)), End(device, lambda data: near.deliver(data))
    near.other, far.other = far, near
    return near, far
