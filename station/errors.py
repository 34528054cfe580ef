"""Errors of the station before anything moves, and their sentences, ``sentences.toml``."""

from functools import partial

from drivers.packaged import packaged_toml, sentence_of

EXIT_USAGE = 2
EXIT_ABORTED = 3
EXIT_FAULT = 4

sentence = partial(sentence_of, packaged_toml("station", "sentences.toml"))


class UsageError(Exception):
    """Wrong usage or unreadable input; the message says what to do."""


class BenchError(UsageError):
    """An invalid bench file; the message names file, line and key."""


class ScriptError(UsageError):
    """A script that cannot be read, or asks for what the table cannot do."""
