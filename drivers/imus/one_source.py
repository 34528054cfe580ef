"""What drivers of devices that are one source have in common."""

from typing import Generic, Protocol, TypeVar


class _Link(Protocol):
    async def open(self) -> None: ...

    def close(self) -> None: ...


L = TypeVar("L", bound=_Link)


class OneSource(Generic[L]):
    """One source, of the name of its device, on a link of its own."""

    def __init__(self, device: str, link: L) -> None:
        """Take the link, which is not open yet."""
        self._device, self._link = device, link

    @property
    def names(self) -> tuple[str, ...]:
        """Name of the one source."""
        return (self._device,)

    async def open(self) -> None:
        """Open the link."""
        await self._link.open()

    def close(self) -> None:
        """Close the link."""
        self._link.close()
