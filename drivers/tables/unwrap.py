"""Angles of a table that reports them within one turn, counted over all turns."""


class Unwrapper:
    """Continues angles over full turns, using the rate to find the right turn.

    Right as long as readings are so close together that the mean of two rates predicts the angle between them to less
    than half a turn. A table that once reports a turn or more counts turns itself: its angles are then used as they
    are.
    """

    def __init__(self, turn: float) -> None:
        """``turn`` is one turn in the unit of the angles; rates are in that unit a second."""
        self._turn = turn
        self._counts_turns = False
        self._last: tuple[float, float, float] | None = None  # time, angle counted on, rate

    @property
    def last_s(self) -> float:
        """When the last reading was, in seconds; minus infinity before the first."""
        return self._last[0] if self._last is not None else float("-inf")

    def restart(self) -> None:
        """Forget the turns: the next reading counts as within half a turn of zero."""
        self._last = None

    def place(self, t_s: float, reported: float, rate: float) -> float:
        """Return the continuous angle for a reading: time ``t_s``, ``reported`` angle and rate, in the unit of the turn
        and per s.

        The first reading is taken to within half a turn of zero. Once an angle of more than a turn is told, the
        controller counts turns itself, and angles are returned as they are told.
        """
        self._counts_turns |= abs(reported) >= self._turn * 1.0001
        expected = 0.0
        if self._last is not None:
            last_s, last_angle, last_rate = self._last
            expected = last_angle + 0.5 * (last_rate + rate) * (t_s - last_s)
        angle = reported if self._counts_turns else reported + self._turn * round((expected - reported) / self._turn)
        self._last = t_s, angle, rate
        return angle
