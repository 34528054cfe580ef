"""A C99 header with the function that turns outputs of the gyros into the rate of their body, in double."""

from __future__ import annotations

import re

from drivers.arrays import Floats
from estimator.compensation import Acts
from station.exporting.exported import Exported
from station.exporting.function_text import argument_names, arguments_said, cautions, function_text, tables
from station.exporting.terms import terms_of
from station.exporting.written import Written, head, number


def write_c(exported: Exported) -> Written:
    """Return the header; CompensationError for gyros that do not span space."""
    terms = terms_of(exported.compensation)
    not_held = cautions(exported, terms)
    prefix = identifier(exported.name)
    what = f"{prefix}_correct: outputs of {len(exported.gyros)} gyros (rad/s) to the rate of their body (rad/s). C99."
    declared = {
        "rate_rps": f"const double rate_rps[{prefix}_gyros]",
        "temperature_c": "double temperature_c",
        "accel": "const double accel[3]",
        "dt_s": "double dt_s",
    }
    arguments = [f"{prefix}_state *state"] if terms.keeps_state else []
    arguments += [*(declared[name] for name in argument_names(terms)), "double w_rps[3]"]
    text = function_text(
        _HEADER,
        exported,
        terms,
        lambda term: f"{prefix}_{term.table}",
        {"axis": f"{prefix}_axis", "value": "(", "sign": f"{prefix}_sign"}
        | {name: f"{prefix}_{name}(state, " for name in ("follow", "last")},
        {
            "head": map(_said_line, head(exported, what, not_held, " *")),
            "tables": tables(exported, terms, "/* {} */".format, f"{prefix}_{{}}".format, _table),
            "said": map(_said, arguments_said(exported, terms)),
        },
        p=prefix,
        upper=prefix.upper(),
        arguments=", ".join(arguments),
        beside="".join(_GIVEN[name] for name in terms.given_to_the_rate),
        simple=f"void {prefix}_solve" if terms.of(Acts.RATE) else f"int {prefix}_invert",
    )
    return Written(text, tuple(not_held))


_GIVEN = {"warmth": ", double warmth", "time_s": ", double time_s", "accel": ", const double accel[3]"}
_HEADER = """
          |/*
head      |$it
          | */
          |#ifndef ${upper}_CORRECTION_H
          |#define ${upper}_CORRECTION_H
          |
          |#include <math.h>
          |
          |enum { ${p}_gyros = $gyros };
          |
          |/* A sample stamped t shows the rate at t less this, in s. */
          |#define ${upper}_DELAY_S $delay_s
          |
tables    |$it
state     |/* What is kept from sample to sample; reset it at the start and after a gap. */
state     |typedef struct {
state     |    int started;
time_s    |    double time_s; /* since the gyros were switched on; set it if they run already */
bandwidth |    double rate_rps[${p}_gyros]; /* of the sample before, as all that follows */
wdot      |    double w_rps[3];
memory    |    double kept[$places][${p}_gyros]; /* what functions with memory hold */
state     |} ${p}_state;
state     |
state     |static inline void ${p}_reset(${p}_state *state)
state     |{
state     |    static const ${p}_state empty = {0};
state     |    *state = empty;
state     |}
state     |
follow    |/* What follows x by a share of how far behind it was, no more than a width; skips what is no number. */
follow    |static inline double ${p}_follow(${p}_state *state, int at, int i, double x, double share, double width)
follow    |{
follow    |    double *kept = &state->kept[at][i];
follow    |    if (!state->started || !isfinite(*kept))
follow    |        *kept = x;
follow    |    else if (isfinite(x))
follow    |        *kept = x + share * fmin(fmax(*kept - x, -width), width);
follow    |    return isfinite(x) ? *kept : x;
follow    |}
follow    |
last      |/* The sign that x had last beyond a limit, or beyond $share of its largest size so far if the limit is 0. */
last      |static inline double ${p}_last(${p}_state *state, int at, int i, double x, double limit)
last      |{
last      |    double *largest = &state->kept[at][i], *sign = &state->kept[at + 1][i];
last      |    if (isfinite(x)) {
last      |        *largest = fmax(*largest, fabs(x));
last      |        if (fabs(x) > (limit > 0.0 ? limit : $share * *largest))
last      |            *sign = x > 0.0 ? 1.0 : -1.0;
last      |    }
last      |    return *sign;
last      |}
last      |
sign      |static inline double ${p}_sign(double x)
sign      |{
sign      |    return isnan(x) ? x : (x > 0.0) - (x < 0.0);
sign      |}
sign      |
          |static inline $simple(const double left[${p}_gyros], double w_rps[3])
          |{
          |    int i, r;
          |    for (r = 0; r < 3; r++) {
          |        w_rps[r] = 0.0;
          |        for (i = 0; i < ${p}_gyros; i++)
          |            w_rps[r] += ${p}_solution[r][i] * left[i];
          |    }
no rate   |    return 0;
          |}
          |
rate      |/* Undoes what depends on the rate itself, by iteration; returns 1 and leaves it in if that has no end. */
rate      |static inline int ${p}_invert(const double left[${p}_gyros]$beside, double w[3])
rate      |{
rate      |    double less[${p}_gyros], next[3], change;
rate      |    int i, r, pass;
rate      |    ${p}_solve(left, w);
rate      |    for (pass = 0; pass < $iterations; pass++) {
rate      |        for (i = 0; i < ${p}_gyros; i++) {
u rate    |            const double u = ${p}_axis[i][0] * w[0] + ${p}_axis[i][1] * w[1] + ${p}_axis[i][2] * w[2];
rate      |            less[i] = left[i];
of rate   |            less[i] -= $it;
rate      |        }
rate      |        ${p}_solve(less, next);
rate      |        change = 0.0;
rate      |        for (r = 0; r < 3; r++) {
rate      |            change += fabs(next[r] - w[r]);
rate      |            w[r] = next[r];
rate      |        }
rate      |        if (change <= $tolerance)
rate      |            return 0;
rate      |    }
rate      |    ${p}_solve(left, w);
rate      |    return 1;
rate      |}
rate      |
          |/*
said      | * $it
          | * w_rps (out): rate of the body about its axes x, y, z, in rad/s
rate      | * Returns 0; 1 if the rate is no number or far beyond the calibration: effects of the rate are then left in.
no rate   | * Returns 0.
          | */
          |static inline int ${p}_correct($arguments)
          |{
          |    double left[${p}_gyros];
          |    int i;
warmth    |    const double warmth = temperature_c - $reference_c;
time_s    |    const double time_s = state->started ? state->time_s + dt_s : state->time_s;
step      |    const double step = state->started && dt_s > 0.0 ? dt_s : 0.0;
slope     |    const double share = $slope_s / ($slope_s + step);
slope     |    const double smooth = ${p}_follow(state, $places - 1, 0, temperature_c, share, 1e300);
slope     |    const double slope = (temperature_c - smooth) / $slope_s;
motion    |    double w[3];
wdot      |    double wdot[3] = {0.0, 0.0, 0.0};
wdot      |    int r;
          |    for (i = 0; i < ${p}_gyros; i++) {
          |        left[i] = rate_rps[i] + ${p}_bias[i];
bandwidth |        if (state->started && dt_s > 0.0 && isfinite(rate_rps[i] - state->rate_rps[i]))
bandwidth |            left[i] += $lag[i] * (rate_rps[i] - state->rate_rps[i]) / dt_s;
bandwidth |        state->rate_rps[i] = rate_rps[i];
added     |        left[i] -= $it;
          |    }
motion    |    if (${p}_invert(left$passed, w))
motion    |        w[0] = w[1] = w[2] = NAN;
wdot      |    for (r = 0; r < 3; r++) {
wdot      |        if (state->started && dt_s > 0.0 && isfinite(w[r] - state->w_rps[r]))
wdot      |            wdot[r] = (w[r] - state->w_rps[r]) / dt_s;
wdot      |        state->w_rps[r] = w[r];
wdot      |    }
motion    |    for (i = 0; i < ${p}_gyros; i++) {
u motion  |        const double u = ${p}_axis[i][0] * w[0] + ${p}_axis[i][1] * w[1] + ${p}_axis[i][2] * w[2];
of motion |        left[i] -= $it;
motion    |    }
time_s    |    state->time_s = time_s;
state     |    state->started = 1;
          |    return ${p}_invert(left$passed, w_rps);
          |}
          |
          |#endif /* ${upper}_CORRECTION_H */
"""


def identifier(name: str) -> str:
    """Return what a device is called in source code."""
    word = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") or "imu"
    return word if word[0].isalpha() else f"imu_{word}"


def _said_line(line: str) -> str:
    return " *" + _said(line.removeprefix(" *"))


def _said(text: str) -> str:
    """Return a text that may stand in a comment."""
    return text.replace("*/", "* /").replace("/*", "/ *").replace("??/", "?? /")


def _table(name: str, values: Floats) -> list[str]:
    if values.ndim == 1:
        return [f"static const double {name}[{len(values)}] = {{{', '.join(map(number, values))}}};", ""]
    rows = [f"    {{{', '.join(map(number, row))}}}," for row in values]
    rows[-1] = rows[-1].rstrip(",")
    return [f"static const double {name}[{len(values)}][{values.shape[1]}] = {{", *rows, "};", ""]
