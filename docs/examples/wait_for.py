"""A step of one's own, of a duration that is not known in advance: stand still until the temperature has settled.

A script file says ``kind = "wait_for"`` and gives the keys below. A command takes the file by ``--plugin wait_for.py``,
a bench file by ``plugins = ["wait_for.py"]``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drivers.specs import Key
from station.scripts.steps.kind import Part, Stage, Step, StepKind


@dataclass(frozen=True, slots=True)
class WaitFor(Step):
    """Stand still until no device has changed by more than ``change_c`` within the last ``window_s``."""

    least_s: float
    most_s: float
    change_c: float
    window_s: float
    label: str

    def words(self) -> str:
        return f"wait for {self.change_c:g} degC in {self.window_s:g} s"

    def problem(self) -> str:
        in_order = 0 < self.window_s <= self.least_s <= self.most_s
        return "" if in_order else "window, least and most must be above zero, and none above the next"

    def parts(self, angles_rad: Mapping[str, float]) -> Sequence[Part]:
        return (Part.standing(self.least_s, self.most_s),)

    async def carry_out(self, stage: Stage, parts: Sequence[Part]) -> None:
        await stage.stand(self.least_s - self.window_s)
        waited_s = self.least_s - self.window_s
        before = stage.newest("temperature_c")
        while waited_s < self.most_s:
            pause_s = min(self.window_s, self.most_s - waited_s)
            await stage.stand(pause_s)
            waited_s += pause_s
            now = stage.newest("temperature_c")
            if now and all(abs(now[name] - before.get(name, -273.15)) <= self.change_c for name in now):
                return
            before = now
        stage.tell(f"step {self.label!r} ended after {waited_s:g} s: the temperature had not settled")


SPEC = StepKind(
    name="wait_for",
    what="stand still until the temperature of every device has settled",
    keys=(
        Key(name="least", kind="time", doc="how long at least", required=True, field="least_s"),
        Key(name="most", kind="time", doc="how long at most", required=True, field="most_s"),
        Key(name="change", kind="temperature", doc="largest change", default="0.1 degC", field="change_c"),
        Key(name="window", kind="time", doc="in which time", default="60 s", field="window_s"),
    ),
    make=WaitFor,
)
