"""A C99 header with the function that turns outputs of the gyros into the rate of their body, in double."""

from __future__ import annotations

import re

from drivers.arrays import Floats
from estimator.compensation import MOST_ITERATIONS, SLOPE_S, TOLERANCE_RPS
from estimator.effects.thermal import REFERENCE_C
from station.exporting.exported import Exported
from station.exporting.function_text import argument_names, arguments_said, cautions
from station.exporting.terms import Term, Terms, terms_of
from station.exporting.written import Written, head, number


def write_c(exported: Exported) -> Written:
    """Return the header; CompensationError for gyros that do not span space."""
    solution = exported.compensation.solution
    terms = terms_of(exported.compensation)
    not_held = cautions(exported, terms)
    prefix = identifier(exported.name)
    guard = f"{prefix.upper()}_CORRECTION_H"
    what = f"{prefix}_correct: outputs of {len(exported.gyros)} gyros (rad/s) to the rate of their body (rad/s). C99."
    lines = [
        "/*",
        *map(_said_line, head(exported, what, not_held, " *")),
        " */",
        f"#ifndef {guard}",
        f"#define {guard}",
        "",
        "#include <math.h>",
        "",
        f"enum {{ {prefix}_gyros = {len(exported.gyros)} }};",
        "",
        "/* A sample stamped t shows the rate at t less this, in s. */",
        f"#define {prefix.upper()}_DELAY_S {number(exported.compensation.delay_s)}",
        "",
        *_tables(exported, terms, solution, prefix),
        *_state(terms, prefix),
        *_inverse(terms, prefix),
        *_correct(exported, terms, prefix),
        f"#endif /* {guard} */",
    ]
    return Written("\n".join(lines) + "\n", tuple(not_held))


def identifier(name: str) -> str:
    """Return what a device is called in source code."""
    word = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") or "imu"
    return word if word[0].isalpha() else f"imu_{word}"


def _said_line(line: str) -> str:
    return " *" + _said(line.removeprefix(" *"))


def _said(text: str) -> str:
    """Return a text that may stand in a comment."""
    return text.replace("*/", "* /").replace("/*", "/ *").replace("??/", "?? /")


def _tables(exported: Exported, terms: Terms, solution: Floats, prefix: str) -> list[str]:
    lines = [
        "/* Body rate per output: the inverse of the sensitivity, rows x, y, z. */",
        *_table(f"{prefix}_solution", solution),
        "/* Biases, to be added to the outputs, in rad/s. */",
        *_table(f"{prefix}_bias", exported.compensation.bias_rps),
    ]
    if terms.of_the_rate:
        lines += ["/* Nominal sense axes. */", *_table(f"{prefix}_axis", exported.compensation.array.p)]
    for term in terms.all:
        lines += [f"/* {term.effect.replace('_', ' ')}: {term.unit} */", *_table(f"{prefix}_{term.table}", term.values)]
    return lines


def _table(name: str, values: Floats) -> list[str]:
    if values.ndim == 1:
        return [f"static const double {name}[{len(values)}] = {{{', '.join(map(number, values))}}};", ""]
    rows = [f"    {{{', '.join(map(number, row))}}}," for row in values]
    rows[-1] = rows[-1].rstrip(",")
    return [f"static const double {name}[{len(values)}][{values.shape[1]}] = {{", *rows, "};", ""]


def _written(term: Term, prefix: str) -> str:
    return term.written(f"{prefix}_{term.table}")


def _state(terms: Terms, prefix: str) -> list[str]:
    if not terms.keeps_state:
        return []
    fields = ["    int started;"]
    if terms.uses("time_s"):
        fields.append("    double time_s; /* since the gyros were switched on; set it if they run already */")
    if terms.lag is not None:
        fields.append(f"    double rate_rps[{prefix}_gyros]; /* of the sample before, as all that follows */")
    if terms.uses("slope"):
        fields.append("    double smooth_c;")
    if terms.uses("wdot"):
        fields.append("    double w_rps[3];")
    return [
        "/* What is kept from sample to sample; reset it at the start and after a gap. */",
        "typedef struct {",
        *fields,
        f"}} {prefix}_state;",
        "",
        f"static inline void {prefix}_reset({prefix}_state *state)",
        "{",
        f"    static const {prefix}_state empty = {{0}};",
        "    *state = empty;",
        "}",
        "",
    ]


def _inverse(terms: Terms, prefix: str) -> list[str]:
    n = f"{prefix}_gyros"
    name, kind, end = ("solve", "void", []) if terms.of_the_rate else ("invert", "int", ["    return 0;"])
    lines = [
        f"static inline {kind} {prefix}_{name}(const double left[{n}], double w_rps[3])",
        "{",
        "    int i, r;",
        "    for (r = 0; r < 3; r++) {",
        "        w_rps[r] = 0.0;",
        f"        for (i = 0; i < {n}; i++)",
        f"            w_rps[r] += {prefix}_solution[r][i] * left[i];",
        "    }",
        *end,
        "}",
        "",
    ]
    if not terms.of_the_rate:
        return lines
    warmth = "double warmth, " if terms.warms_the_rate else ""
    return [
        *lines,
        "/* Undoes what depends on the rate itself, by iteration; returns 1 and leaves it in if that has no end. */",
        f"static inline int {prefix}_invert(const double left[{n}], {warmth}double w_rps[3])",
        "{",
        f"    double less[{n}], next[3], change, u;",
        "    int i, r, step;",
        f"    {prefix}_solve(left, w_rps);",
        f"    for (step = 0; step < {MOST_ITERATIONS}; step++) {{",
        f"        for (i = 0; i < {n}; i++) {{",
        "            u = 0.0;",
        "            for (r = 0; r < 3; r++)",
        f"                u += {prefix}_axis[i][r] * w_rps[r];",
        "            less[i] = left[i];",
        *(f"            less[i] -= {_written(term, prefix)};" for term in terms.of_the_rate),
        "        }",
        f"        {prefix}_solve(less, next);",
        "        change = 0.0;",
        "        for (r = 0; r < 3; r++) {",
        "            change += fabs(next[r] - w_rps[r]);",
        "            w_rps[r] = next[r];",
        "        }",
        f"        if (change <= {number(TOLERANCE_RPS)})",
        "            return 0;",
        "    }",
        f"    {prefix}_solve(left, w_rps);",
        "    return 1;",
        "}",
        "",
    ]


def _correct(exported: Exported, terms: Terms, prefix: str) -> list[str]:
    n = f"{prefix}_gyros"
    declared = {
        "rate_rps": f"const double rate_rps[{n}]",
        "temperature_c": "double temperature_c",
        "accel": "const double accel[3]",
        "dt_s": "double dt_s",
    }
    arguments = [f"{prefix}_state *state"] if terms.keeps_state else []
    arguments += [*(declared[name] for name in argument_names(terms)), "double w_rps[3]"]
    warmth = "warmth, " if terms.warms_the_rate else ""
    body = [f"    double left[{n}];", "    int i;"]
    if terms.uses("warmth"):
        body.append(f"    const double warmth = temperature_c - {number(REFERENCE_C)};")
    if terms.uses("time_s"):
        body += ["    const double time_s = state->started ? state->time_s + dt_s : state->time_s;"]
    if terms.uses("slope"):
        body += ["    const double step = state->started && dt_s > 0.0 ? dt_s : 0.0;", "    double slope;"]
    if terms.uses("wdot"):
        body += ["    double wdot[3] = {0.0, 0.0, 0.0}, w[3];", "    int r;"]
    if terms.uses("slope"):
        body += [
            "    if (!state->started || isnan(state->smooth_c))",
            "        state->smooth_c = temperature_c;",
            "    else if (!isnan(temperature_c))",
            f"        state->smooth_c += (temperature_c - state->smooth_c) * step / ({number(SLOPE_S)} + step);",
            f"    slope = (temperature_c - state->smooth_c) / {number(SLOPE_S)};",
        ]
    body.append(f"    for (i = 0; i < {n}; i++) {{")
    body.append(f"        left[i] = rate_rps[i] + {prefix}_bias[i];")
    if terms.lag is not None:
        body += [
            "        if (state->started && dt_s > 0.0 && isfinite(rate_rps[i] - state->rate_rps[i]))",
            f"            left[i] += {prefix}_{terms.lag.table}[i] * (rate_rps[i] - state->rate_rps[i]) / dt_s;",
            "        state->rate_rps[i] = rate_rps[i];",
        ]
    body += [f"        left[i] -= {_written(term, prefix)};" for term in terms.added]
    body.append("    }")
    if terms.of_acceleration is not None:
        body += [
            f"    if ({prefix}_invert(left, {warmth}w))",
            "        w[0] = w[1] = w[2] = NAN;",
            "    for (r = 0; r < 3; r++) {",
            "        if (state->started && dt_s > 0.0 && isfinite(w[r] - state->w_rps[r]))",
            "            wdot[r] = (w[r] - state->w_rps[r]) / dt_s;",
            "        state->w_rps[r] = w[r];",
            "    }",
            f"    for (i = 0; i < {n}; i++)",
            f"        left[i] -= {_written(terms.of_acceleration, prefix)};",
        ]
    if terms.uses("time_s"):
        body.append("    state->time_s = time_s;")
    if terms.keeps_state:
        body.append("    state->started = 1;")
    body.append(f"    return {prefix}_invert(left, {warmth}w_rps);")
    return [
        "/*",
        *(f" * {_said(line)}" for line in arguments_said(exported, terms)),
        " * w_rps (out): rate of the body about its axes x, y, z, in rad/s",
        " * Returns 0; 1 if the rate is no number or far beyond the calibration: effects of the rate are then left in."
        if terms.of_the_rate
        else " * Returns 0.",
        " */",
        f"static inline int {prefix}_correct({', '.join(arguments)})",
        "{",
        *body,
        "}",
        "",
    ]
