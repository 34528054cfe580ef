"""The methods of the app that bars and screens use."""

from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, Protocol

from station.screen.archive.archive import Archive
from station.screen.choices import Choices
from station.screen.sessions.live_run import LiveRun
from station.screen.sessions.tray import Tray
from station.screen.tabs.prospects import Prospect


class SeenApp(Protocol):
    """What screens need of the app: the session shown, the operator's choices, and requests; ``StationApp`` provides
    it.
    """

    shown: LiveRun | None
    others: int
    """How many sessions run that are not shown."""
    choices: Choices
    archive: Archive
    operator_utc_s: float
    """When the operator was entered or confirmed, in seconds since 1970."""
    bench_recalled: bool
    """Whether the bench is only remembered from the last run: real hardware of it is not opened yet."""
    mounted: bool
    """Whether the operator has mounted a device of the tray, whose run starts once nothing stands against it."""

    @property
    def busy(self) -> bool: ...
    @property
    def tray(self) -> Tray: ...
    def action_stop(self) -> None: ...
    def show_stop(self) -> None: ...
    def start_run(self, prospect: Prospect) -> None: ...
    def pause_run(self) -> None: ...
    def drive(self, action: str, **given: str | float) -> None: ...
    def note_run(self, text: str | None) -> None: ...
    def prepare(self, script: str | None) -> None: ...
    def open_recording(self, path: Path) -> None: ...
    def choose_session(self) -> None: ...
    def take_recording(self) -> tuple[Path, bool] | None: ...
    def work(self, task: Callable[[], Coroutine[Any, Any, None]], group: str) -> None: ...
