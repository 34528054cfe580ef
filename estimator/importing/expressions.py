"""Regular expressions of others: searched in a process of their own, which can be ended when they do not end."""

import json
import re
import subprocess
import sys

SEARCH_LIMIT_S = 5.0
_SEARCH = """
import json, re, sys
pattern, flags, text = json.load(sys.stdin)
found = re.compile(pattern, flags).search(text)
json.dump(found and found.groupdict(), sys.stdout)
"""


def groups_of(pattern: re.Pattern[str], text: str) -> dict[str, str | None] | None:
    """Return the named groups of the first match of ``pattern`` in ``text``; None if there is none.

    A group that took no part in the match is None, too.

    The search runs in a child process, as backtracking may take very long: TimeoutError after ``SEARCH_LIMIT_S``.
    """
    asked = json.dumps([pattern.pattern, pattern.flags, text])
    try:
        done = subprocess.run(
            [sys.executable, "-I", "-S", "-c", _SEARCH],
            input=asked,
            capture_output=True,
            text=True,
            timeout=SEARCH_LIMIT_S,
            check=True,
        )
    except subprocess.TimeoutExpired:
        raise TimeoutError from None
    found: dict[str, str | None] | None = json.loads(done.stdout)
    return found
