"""What an investigation left of the residual, for pictures and files: over time, and as spectra."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from drivers.types import Floats
from estimator.tracing.investigation import Investigation, ResidualView
from estimator.tracing.residuals.residual import Residual


@dataclass(frozen=True, slots=True, eq=False)
class Spectra:
    """One-sided densities (f,) of the residual of a gyro before and after, and of its noise, (rad/s)^2/Hz."""

    frequency_hz: Floats
    before: Floats
    after: Floats
    noise: Floats


def spectra_of(before: Residual | None, after: Residual | None) -> dict[str, Spectra]:
    """Return the spectra by gyro, none if the residual was not looked at."""
    if before is None or after is None:
        return {}
    pairs = zip(before.gyros, after.gyros, strict=True)
    return {
        old.name: Spectra(old.spectrum.frequency_hz, old.spectrum.density, new.spectrum.density, old.spectrum.noise)
        for old, new in pairs
    }


def judged_spectra(found: Investigation) -> dict[str, Spectra]:
    """Return the spectra of the run that verifies, without one of the recordings that were fitted."""
    verified = spectra_of(found.verified_before, found.verified_after)
    return verified or spectra_of(found.residual_before, found.residual_after)


def judged_views(views: Iterable[ResidualView]) -> list[ResidualView]:
    """Return the views that judge, of one run: the verification run, without one the first recording."""
    known = list(views)
    judging = [view for view in known if view.verification] or known
    return [view for view in judging if view.run == judging[0].run]
