"""The C99 controller of a bundle: static arrays, no allocation, no library but math.h.

Whether a number is finite is read off its bits, since -ffast-math lets a compiler drop `isfinite`.
"""

from typing import Any

import numpy as np


LANES = 4  # outputs that are added up side by side, so that sums do not wait for each other
Arrays = Any  # names to arrays

INCLUDES = """#include "controller.h"

#include <math.h>
#include <stdint.h>
#include <string.h>
"""
COMMON = """
#define MOST(a, b) ((a) > (b) ? (a) : (b))

typedef struct {
    int rows, columns; /* inputs; outputs, a multiple of %(lanes)d */
    const float *weight, *bias; /* weight[columns / %(lanes)d][rows][%(lanes)d] */
} layer;

/* 1 unless x is infinite or not a number, whatever the compiler believes of its arithmetic. */
static int is_finite(float x)
{
    uint32_t bits;
    memcpy(&bits, &x, sizeof bits);
    return (bits & 0x7f800000u) != 0x7f800000u;
}

static int all_finite(const float *x, int n)
{
    int i, sound = 1;
    for (i = 0; i < n; i++) sound &= is_finite(x[i]);
    return sound;
}

static float clipped(float x, float most)
{
    return x > most ? most : x < -most ? -most : x;
}

static void apply(const layer *l, const float *x, float *y, int rectified)
{
    int i, j, k;
    for (j = 0; j < l->columns; j += %(lanes)d) {
        const float *w = l->weight + (size_t)j * (size_t)l->rows;
        float sum[%(lanes)d];
        for (k = 0; k < %(lanes)d; k++) sum[k] = l->bias[j + k];
        for (i = 0; i < l->rows; i++, w += %(lanes)d)
            for (k = 0; k < %(lanes)d; k++) sum[k] += x[i] * w[k];
        for (k = 0; k < %(lanes)d; k++) y[j + k] = rectified && sum[k] < 0.0f ? 0.0f : sum[k];
    }
}

static const float limits[MARLYAP_INPUTS] = {%(limits)s};

/* The command for an observation; 0 where it is not finite. */
static int decide(const layer *net, const float *observation, float *command)
{
    float a[%(width)d], b[%(width)d];
    const float *x = observation;
    float *y = a;
    int k;
    for (k = 0; k < %(layers)d; k++) {
        apply(net + k, x, y, k < %(layers)d - 1);
        x = y;
        y = x == a ? b : a;
    }
    for (k = 0; k < MARLYAP_INPUTS; k++) command[k] = limits[k] * tanhf(x[k]);
    return all_finite(command, MARLYAP_INPUTS);
}
"""
SENSES = """
static const float gain[MARLYAP_INPUTS][MARLYAP_STATE] = {%(gain)s};

static void fallback(const float *own, float *command)
{
    int i, j;
    for (i = 0; i < MARLYAP_INPUTS; i++) {
        float sum = 0.0f;
        for (j = 0; j < MARLYAP_STATE; j++)
            if (is_finite(own[j])) sum += gain[i][j] * own[j];
        command[i] = clipped(sum, limits[i]);
    }
}

/* A vector of the world in the robot's axes, whose first is (c, s). */
static void turned(float c, float s, float x, float y, float *out)
{
    out[0] = x * c + y * s;
    out[1] = y * c - x * s;
}

static void magnified(const float *v, float *out)
{
    const float size = sqrtf(v[0] * v[0] + v[1] * v[1] + 1e-12f) + %(scale)s;
    out[0] = v[0] / size;
    out[1] = v[1] / size;
}

static void observe(int leads, const float (*shift)[2], const float *own, const float *goal,
                    const float *neighbours, const unsigned char *present, float *out)
{
    const float c = %(cos)s, s = %(sin)s;
    float *to = out;
    int k, j;
%(rates)s    *to++ = leads ? 1.0f : 0.0f;
    memset(to, 0, 4 * sizeof *to);
    if (leads) {
        turned(c, s, goal[0] - own[0], goal[1] - own[1], to);
        magnified(to, to + 2);
    }
    to += 4;
    for (k = 0; k < MARLYAP_SLOTS; k++, to += 3 + MARLYAP_MESSAGE) {
        const float *m = neighbours + k * MARLYAP_MESSAGE;
        memset(to, 0, (3 + MARLYAP_MESSAGE) * sizeof *to);
        if (!present[k]) continue;
        to[0] = 1.0f;
        turned(c, s, m[0] - own[0] + shift[k][0], m[1] - own[1] + shift[k][1], to + 1);
        magnified(to + 1, to + 3);
        for (j = 2; j < MARLYAP_MESSAGE; j += 2) turned(c, s, m[j], m[j + 1], to + j + 3);
    }
}

static int act(const layer *net, int leads, const float (*shift)[2], const float *own,
               float age, const float *goal, const float *neighbours, const unsigned char *present,
               float *command)
{
    float observation[MARLYAP_OBSERVATION];
    int k, sound = all_finite(own, MARLYAP_STATE) && is_finite(age) && age <= %(max_age)s;
    if (leads) sound = sound && goal != NULL && all_finite(goal, 2);
    for (k = 0; k < MARLYAP_SLOTS; k++)
        if (present[k])
            sound = sound && all_finite(neighbours + k * MARLYAP_MESSAGE, MARLYAP_MESSAGE);
    if (sound) {
        observe(leads, shift, own, goal, neighbours, present, observation);
        if (decide(net, observation, command)) return 0;
    }
    fallback(own, command);
    return 1;
}
"""
ROBOT = """
int marlyap_%(name)s(const float *own, float age, const float *goal, const float *neighbours,
    const unsigned char *present, float *command)
{
    return act(%(net)s, %(leads)d, %(name)s_shift, own, age, goal, neighbours, present, command);
}
"""
PLAIN = """
int marlyap_%(name)s(const float *observation, float age, float *command)
{
    int k, sound = all_finite(observation, MARLYAP_OBSERVATION);
    if (sound && is_finite(age) && age <= %(max_age)s && decide(%(net)s, observation, command))
        return 0;
    for (k = 0; k < MARLYAP_INPUTS; k++) command[k] = 0.0f;
    return 1;
}
"""
ROBOT_HEADER = """/* Arguments: own[%(state)d], the robot's own state; age of it (s);
goal[2] (m), NULL where it is told none;
neighbours[%(slots)d][%(message)d] and present[%(slots)d], what it has heard;
command[%(inputs)d], the answer.
Returns 1 where the command is the fallback. contract.json has names, units and order. */
"""
PLAIN_HEADER = """/* Arguments: observation[%(observation)d]; age of it (s);
command[%(inputs)d], the answer.
Returns 1 where the command is the fallback. contract.json has names, units and order. */
"""


def number(x: Any) -> str:
    """A float as C has it, which reads back as the same one."""
    text = f"{np.float32(x):.9g}"
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"


def _listed(values: Any) -> str:
    return ", ".join(map(number, values))


def sizes(body: dict[str, Any]) -> dict[str, int]:
    """What the macros of the header are."""
    sight = body["sight"]
    return {
        "state": len(body["state"]),
        "inputs": len(body["action"]["channels"]),
        "observation": body["observation"]["size"],
        "slots": len(body["roles"][0]["neighbours"]),
        "message": sight["message"] if sight else 0,
    }


def header(body: dict[str, Any]) -> str:
    """controller.h"""
    n, robots = sizes(body), body["sight"] is not None
    told = (ROBOT_HEADER if robots else PLAIN_HEADER) % n
    macros = "".join(f"#define MARLYAP_{k.upper()} {v}\n" for k, v in n.items())
    given = "const float *goal, const float *neighbours,\n    const unsigned char *present, "
    first = (
        f"const float *own, float age, {given}"
        if robots
        else "const float *observation, float age, "
    )
    calls = "".join(f"int marlyap_{r['name']}({first}float *command);\n" for r in body["roles"])
    guard = "MARLYAP_CONTROLLER_H"
    return f"#ifndef {guard}\n#define {guard}\n\n{macros}\n{told}{calls}\n#endif\n"


def source(body: dict[str, Any], arrays: Arrays) -> str:
    """controller.c"""
    robots, layers = body["sight"] is not None, body["action"]["layers"]
    nets = sorted({role["network"] for role in body["roles"]})
    wide = [_padded(len(arrays[f"{net}.{k}.bias"])) for net in nets for k in range(layers)]
    limits = [c["limit"] for c in body["action"]["channels"]]
    common = {"lanes": LANES, "limits": _listed(limits), "layers": layers, "width": max(wide)}
    common["max_age"] = number(body["timing"]["max_own_age"])
    parts = [f"/* {body['task']}, policy {body['policy'][:12]}; see contract.json. */\n"]
    parts += [INCLUDES, COMMON % common, *(_network(net, arrays, layers) for net in nets)]
    if robots:
        parts.append(SENSES % (common | _senses(body)))
    for role in body["roles"]:
        about = common | {"name": role["name"], "net": f"{role['network']}_layers"}
        if robots:
            rows = ", ".join(f"{{{_listed(pair)}}}" for pair in role["shift"]) or "{0.0f, 0.0f}"
            size = f"[{max(1, len(role['shift']))}][2]"
            parts.append(f"\nstatic const float {role['name']}_shift{size} = {{{rows}}};\n")
            about["leads"] = int(role["leads"])
        parts.append((ROBOT if robots else PLAIN) % about)
    return "".join(parts)


def _padded(n: int) -> int:
    return -(-n // LANES) * LANES


def _senses(body: dict[str, Any]) -> dict[str, str]:
    sight, gain = body["sight"], body["fallback"]["gain"]
    psi = sight["heading"]
    return {
        "gain": ", ".join(f"{{{_listed(row)}}}" for row in gain),
        "scale": number(sight["scale"]),
        "cos": "1.0f" if psi is None else f"cosf(own[{psi}])",
        "sin": "0.0f" if psi is None else f"sinf(own[{psi}])",
        "rates": "".join(f"    *to++ = own[{k}];\n" for k in sight["rates"]),
    }


def _network(net: str, arrays: Arrays, layers: int) -> str:
    """The weights of one network, in blocks of LANES outputs."""
    text, table = "", []
    for k in range(layers):
        weight, bias = arrays[f"{net}.{k}.weight"], arrays[f"{net}.{k}.bias"]
        rows, columns = weight.shape[1], _padded(weight.shape[0])
        if k:  # the inputs are the outputs before, which are padded too
            rows = _padded(rows)
        w = np.zeros((columns, rows), np.float32)
        w[: weight.shape[0], : weight.shape[1]] = weight
        b = np.zeros(columns, np.float32)
        b[: len(bias)] = bias
        blocks = w.reshape(columns // LANES, LANES, rows).transpose(0, 2, 1)
        for name, values in (("weight", blocks.ravel()), ("bias", b)):
            text += f"\nstatic const float {net}_{k}_{name}[{len(values)}] = {{\n"
            lines = (values[i : i + 12] for i in range(0, len(values), 12))
            text += ",\n".join(_listed(line) for line in lines) + "};\n"
        table.append(f"    {{{rows}, {columns}, {net}_{k}_weight, {net}_{k}_bias}}")
    return text + f"\nstatic const layer {net}_layers[{layers}] = {{\n" + ",\n".join(table) + "};\n"
