"""What bars and screens ask of the app that shows them."""

from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, Protocol

from station.screen.archive.archive import Archive
from station.screen.choices import Choices
from station.screen.sessions.live_run import LiveRun
from station.screen.sessions.tray import Tray
from station.screen.tabs.prospects import Prospect


class SeenApp(Protocol):
    """The session that is shown, what the operator has chosen, and what can be asked for; ``StationApp`` is one."""

    shown: LiveRun | None
    others: int
    choices: Choices
    archive: Archive
    operator_utc_s: float
    bench_recalled: bool
    mounted: bool

    @property
    def busy(self) -> bool: ...
    @property
    def tray(self) -> Tray: ...
    def action_stop(self) -> None: ...
    def start_run(self, prospect: Prospect) -> None: ...
    def pause_run(self) -> None: ...
    def note_run(self, text: str | None) -> None: ...
    def prepare(self, script: str | None) -> None: ...
    def open_recording(self, path: Path) -> None: ...
    def choose_session(self) -> None: ...
    def take_recording(self) -> tuple[Path, bool] | None: ...
    def work(self, what: Callable[[], Coroutine[Any, Any, None]], group: str) -> None: ...
