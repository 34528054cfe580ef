"""Questions to a person, each answered, checked and if need be asked again."""

import sys
from collections.abc import Callable, Mapping

from station.errors import UsageError


class EndedError(Exception):
    """There are no more answers, from the person or the file."""


class Dialogue:
    """Asks on stdout and reads from stdin; with ``asks`` false it accepts every proposal silently."""

    def __init__(self, asks: bool) -> None:
        """``asks``: questions are asked. If the answers come from a pipe, they are printed too."""
        self.asks = asks
        self._echo = asks and sys.stdin is not None and not sys.stdin.isatty()

    def say(self, text: str = "") -> None:
        """Print a text, if questions are asked at all."""
        if self.asks:
            print(text)

    def ask(self, question: str, proposed: str, check: Callable[[str], object] | None = None) -> str:
        """Return an answer that ``check`` accepts; the message of its UsageError is shown and the question repeated.

        Blanks around it are removed. An empty line accepts the proposal, a single - is an empty answer; ``check`` gets
        either like any other. Characters that cannot be printed are refused. If nobody is asked the proposal is
        returned; UsageError if it is wrong. EndedError at the end of the input.
        """
        if not self.asks:
            if check is not None:
                check(proposed)
            return proposed
        while True:
            answer = self._read(f"{question} [{proposed or '-'}]: ").strip()
            answer = {"": proposed, "-": ""}.get(answer, answer)
            try:
                if not answer.isprintable():
                    raise UsageError("that contains characters that cannot be printed")
                if check is not None:
                    check(answer)
            except UsageError as error:
                self.say(f"  {error}")
            else:
                return answer

    def choose(self, question: str, options: Mapping[str, str], proposed: str) -> str:
        """Ask a question, and return the name of one of ``options`` (name and description), shown before.

        An answer is a name or an unambiguous beginning of one, ``proposed`` by default; anything else is asked again.
        If nobody is asked nothing is shown and it is ``proposed``; UsageError if that is wrong. EndedError as ``ask``.
        """
        for name, meaning in options.items():
            self.say(f"    {name:<12} {meaning}")

        def one_of(answer: str) -> None:
            if len(_meant(answer, options)) != 1:
                raise UsageError(f"{answer!r} is not one of {', '.join(options)}")

        return _meant(self.ask(question, proposed, one_of), options)[0]

    def agrees(self, question: str, proposed: bool) -> bool:
        """Ask a question, and return whether the answer is yes; y, ye, n and so on are accepted.

        ``proposed`` is the answer by default, and if nobody is asked. Anything else is asked again. EndedError as
        ``ask``.
        """

        def one_of(answer: str) -> None:
            if not answer or not any(word.startswith(answer.lower()) for word in ("yes", "no")):
                raise UsageError("answer yes or no")

        return self.ask(question, "yes" if proposed else "no", one_of).lower().startswith("y")

    def _read(self, prompt: str) -> str:
        """Return a line of stdin, asked for by ``prompt``; EndedError if none can be read.

        If stdin is not a terminal the line is printed, too.
        """
        if sys.stdin is None:  # started with a closed one
            raise EndedError
        try:
            answer = input(prompt)
        except EOFError:
            print()
            raise EndedError from None
        except (UnicodeDecodeError, OSError):
            raise EndedError from None
        if self._echo:
            print(answer)
        return answer


def _meant(answer: str, options: Mapping[str, str]) -> list[str]:
    return [answer] if answer in options else [name for name in options if answer and name.startswith(answer)]
