"""Common parts of drivers for devices with a link of their own."""

from typing import Generic, TypeVar

from drivers.protocols import Openable

L = TypeVar("L", bound=Openable)


class OneSource(Generic[L]):
    """A device on its own link, with a single source of the same name, unless a subclass says otherwise."""

    def __init__(self, device: str, link: L) -> None:
        """Take the link, which is not open yet."""
        self._device, self._link = device, link

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its sources."""
        return (self._device,)

    async def open(self) -> None:
        """Open the link."""
        await self._link.open()

    def close(self) -> None:
        """Close the link."""
        self._link.close()
