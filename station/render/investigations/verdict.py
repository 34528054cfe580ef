"""What an investigation comes to, in sentences without markup."""

from collections.abc import Iterator, Mapping

from estimator.effects.constructed import readable
from estimator.tracing.investigation import COMMON_CAUSE
from station.views.figures import UNKNOWN, human, probability, whole_percent
from station.views.investigation import AddedView, InvestigationView, OutOfSampleView, UnexplainedView


def verdict_sentences(investigation: InvestigationView) -> list[str]:
    """Return the result in sentences: effects with their parameters, rivals and their sizes, the unexplained part.

    The list is empty if there is none of these.
    """
    lines = [line for added in investigation.added for line in _added(added, len(investigation.gyros))]
    lines += [_rivals(rivals) for rivals in investigation.rivals]
    lines += [_rival_size(rival) for rival in investigation.rival_sizes]
    if investigation.unexplained is not None:
        lines.append(_unexplained(investigation.unexplained))
    return lines


def _added(added: AddedView, gyro_count: int) -> Iterator[str]:
    """Yield an effect that was added, with its probability and the gyros that show it, and below it its parameters.

    What it explains out of sample, and effects that would look the same, follow if there are any.
    """
    likelihood = probability(added.probability)
    yield f"{_name(added)}, probability {likelihood}, shown by {_shown_by(added, gyro_count)}"
    for name, parameters in _by_gyro(added).items():
        yield f"  {name}: {', '.join(parameters)}"
    if added.out_of_sample is not None:
        yield _out_of_sample(added.out_of_sample)
    if added.same:
        same = ", ".join(map(readable, added.same))
        yield f"  {same} would look the same here, but is less likely"


def _name(added: AddedView) -> str:
    """Return the readable name of an effect; that of a constructed law says so, and that no catalogue has it.

    A lag in a constructed law has its uncertainty, if it was estimated.
    """
    if not added.constructed:
        return readable(added.effect)
    name = added.effect
    lag = added.parameters.get("constant")
    if lag is not None:
        name = name.replace(f"lagged by {lag[0]:.4g} s", f"lagged by {human(*lag)}")
    return f"CONSTRUCTED: {name}; not in the catalogue"


def _shown_by(added: AddedView, gyro_count: int) -> str:
    if len(added.gyros) == gyro_count:
        return "all gyros"
    return ", ".join(added.gyros) or "no gyro alone"


def _by_gyro(added: AddedView) -> Mapping[str, list[str]]:
    """Return texts on the parameters: of each gyro, by its name, name and value of its own; of a shared one the value.

    A shared one is by the name of the parameter.
    """
    found: dict[str, list[str]] = {}
    for name, value in added.parameters.items():
        gyro = next((gyro for gyro in added.gyros if name.startswith(f"{gyro} ")), None)
        if gyro is None:
            found.setdefault(name, []).append(human(*value))
        else:
            own_name = name.removeprefix(f"{gyro} ")
            found.setdefault(gyro, []).append(f"{own_name} {human(*value)}")
    return found


def _out_of_sample(out_of_sample: OutOfSampleView) -> str:
    runs = "" if out_of_sample.by_run is None else f"whole recordings by {_whole(out_of_sample.by_run)}, "
    return f"  improves the prediction of held-out data: {runs}steps by {_whole(out_of_sample.by_step)} (log)"


def _whole(value: float | None) -> str:
    return UNKNOWN if value is None else f"{value:.0f}"


def _rivals(rivals: tuple[str, ...]) -> str:
    cannot = "cannot tell apart" if len(rivals) > 1 else "do not prove"
    return f"these recordings {cannot}: {' or '.join(map(readable, rivals))}"


def _rival_size(rival: AddedView) -> str:
    sizes = [f"{name} {human(*value)}" for name, value in rival.parameters.items()]
    return f"  {readable(rival.effect)} would be {', '.join(sizes)}"


def _unexplained(unexplained: UnexplainedView) -> str:
    """Return how much of the residual is unexplained, what that depends on, and that the sigmas allow for it."""
    share = whole_percent(unexplained.share)
    part = f"{share} of the power of the residual depends on {unexplained.depends_on}"
    if unexplained.depends_on == COMMON_CAUSE:
        part = f"{share} of the slow residual comes from {COMMON_CAUSE}: no noise of theirs is alike in all"
    return (
        f"unexplained: {part}. "
        "No effect of the catalogue and no law built from the measured variables explains it. "
        "The sigmas of the states allow for it"
    )
