"""One ONNX file a robot, with the making of the observation inside. Needs onnx, of `robots`.

Opset 17, IR 8: what runtimes of the last years read.
"""

from typing import Any

import numpy as np

from marlyap.deploy.extras import needs


OPSET, IR = 17, 8
Arrays = Any  # names to arrays
BIG = float(np.finfo(np.float32).max)


class Graph:
    """Nodes and constants as they come; a name stands for a tensor."""

    def __init__(self):
        self.onnx = needs("onnx", "export --with onnx")
        self.nodes: list[Any] = []
        self.constants: dict[str, Any] = {}

    def op(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """Add a node; returns the name of its output."""
        name = f"{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(kind, inputs, [name], **attributes))
        return name

    def constant(self, value: Any, dtype: Any = np.float32) -> str:
        """Add an array; returns its name."""
        array = np.ascontiguousarray(value, dtype)
        name = f"constant_{len(self.constants)}"
        self.constants[name] = self.onnx.numpy_helper.from_array(array, name)
        return name

    def named(self, tensor: str, name: str) -> None:
        """Call a tensor, which is an output of the model, by this name."""
        self.nodes.append(self.onnx.helper.make_node("Identity", [tensor], [name]))

    def finite(self, tensor: str) -> str:
        """[1] bool: whether all numbers are finite; |NaN| <= x is false."""
        within = self.op("LessOrEqual", self.op("Abs", tensor), self.constant(BIG))
        flag = self.op("Cast", within, to=self.onnx.TensorProto.FLOAT)
        least = self.op("ReduceMin", flag, keepdims=0)
        return self.op("Greater", self.op("Reshape", least, self.one), self.constant([0.5]))

    @property
    def one(self) -> str:
        return self.constant([1], np.int64)

    def column(self, tensor: str, k: int) -> str:
        """[1]: entry k of a vector."""
        return self.op("Gather", tensor, self.constant([k], np.int64), axis=0)


def graph(body: dict[str, Any], arrays: Arrays, role: dict[str, Any]) -> bytes:
    """The model of one robot as the bytes of an ONNX file, checked by onnx itself.

    Raises UserError where onnx is not installed.
    """
    g = Graph()
    make = g.onnx.helper
    robots = body["sight"] is not None
    inputs, sound, observation, known = (_robot if robots else _plain)(g, body, role)
    command = decided(g, body, arrays, role, observation)
    sound = g.op("And", sound, g.finite(command))
    gain = np.array(body["fallback"]["gain"], np.float32)
    if robots:
        most = np.array([c["limit"] for c in body["action"]["channels"]], np.float32)
        brake = g.op("MatMul", g.constant(gain), known)
        brake = g.op("Min", g.op("Max", brake, g.constant(-most)), g.constant(most))
    else:
        brake = g.constant(np.zeros(len(gain)))
    g.named(g.op("Where", sound, command, brake), "command")
    g.named(g.op("Not", sound), "fallback")
    number, flag = g.onnx.TensorProto.FLOAT, g.onnx.TensorProto.BOOL
    given = [make.make_tensor_value_info(name, number, shape) for name, shape in inputs]
    answers = [
        make.make_tensor_value_info("command", number, [len(gain)]),
        make.make_tensor_value_info("fallback", flag, [1]),
    ]
    made = make.make_graph(
        g.nodes, role["name"], given, answers, initializer=[*g.constants.values()]
    )
    model = make.make_model(
        made, opset_imports=[make.make_opsetid("", OPSET)], ir_version=IR, producer_name="marlyap"
    )
    about = {"task": body["task"], "role": role["name"], "policy": body["policy"]}
    make.set_model_props(model, about)
    g.onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def decided(g: Graph, body: dict[str, Any], arrays: Arrays, role: Any, x: str) -> str:
    """The command [input] for an observation [size]."""
    net, last = role["network"], body["action"]["layers"] - 1
    for k in range(last + 1):
        weight, bias = (g.constant(arrays[f"{net}.{k}.{what}"]) for what in ("weight", "bias"))
        x = g.op("Add", g.op("MatMul", weight, x), bias)
        x = g.op("Relu", x) if k < last else g.op("Tanh", x)
    return g.op("Mul", x, g.constant([c["limit"] for c in body["action"]["channels"]]))


def _fresh(g: Graph, body: dict[str, Any]) -> str:
    """[1] bool: whether the own state is young enough; the age NaN is not."""
    return g.op("LessOrEqual", "age", g.constant([body["timing"]["max_own_age"]]))


def _plain(g: Graph, body: dict[str, Any], role: Any) -> tuple[Any, str, str, str]:
    """Inputs, whether they are sound, the observation, and the state with gaps filled."""
    sound = g.op("And", g.finite("observation"), _fresh(g, body))
    size = body["observation"]["size"]
    return [("observation", [size]), ("age", [1])], sound, "observation", ""


def _robot(g: Graph, body: dict[str, Any], role: Any) -> tuple[Any, str, str, str]:
    """The same for a robot that makes its observation itself."""
    sight, k = body["sight"], len(role["neighbours"])
    zero = g.constant(0.0)
    small = g.op("LessOrEqual", g.op("Abs", "own"), g.constant(BIG))
    known = g.op("Where", small, "own", zero)
    sound = g.op("And", g.finite("own"), _fresh(g, body))
    inputs = [("own", [len(body["state"])]), ("age", [1]), ("goal", [2]), ("told", [1])]
    if role["leads"]:
        told = g.op("Greater", "told", g.constant([0.5]))
        sound = g.op("And", sound, g.op("And", told, g.finite("goal")))
    here = g.op("Slice", "own", g.constant([0], np.int64), g.constant([2], np.int64))
    turn = _axes(g, sight)
    rates = g.op("Gather", "own", g.constant(sight["rates"], np.int64), axis=0)
    parts = [rates] if sight["rates"] else []
    parts.append(g.constant([float(role["leads"])]))
    if role["leads"]:
        gap = g.op("MatMul", turn, g.op("Sub", "goal", here))
        parts += [gap, _magnified(g, gap, sight["scale"], -1)]
    else:
        parts.append(g.constant(np.zeros(4)))
    if k:
        inputs += [("neighbours", [k, sight["message"]]), ("present", [k])]
        seen, sees = _slots(g, sight, role, here, turn)
        sound = g.op("And", sound, sees)
        parts.append(seen)
    return inputs, sound, g.op("Concat", *parts, axis=0), known


def _axes(g: Graph, sight: dict[str, Any]) -> str:
    """What turns a column in the world into the robot's own axes [2, 2]."""
    if sight["heading"] is None:
        return g.constant(np.eye(2))
    psi = g.column("own", sight["heading"])
    c, s = g.op("Cos", psi), g.op("Sin", psi)
    flat = g.op("Concat", c, s, g.op("Neg", s), c, axis=0)
    return g.op("Reshape", flat, g.constant([2, 2], np.int64))


def _magnified(g: Graph, gap: str, scale: float, axis: int) -> str:
    squares = g.op("Mul", gap, gap)
    total = g.op("ReduceSum", squares, g.constant([axis], np.int64), keepdims=1)
    size = g.op("Sqrt", g.op("Add", total, g.constant(1e-12)))
    return g.op("Div", gap, g.op("Add", size, g.constant(scale)))


def _slots(g: Graph, sight: dict[str, Any], role: Any, here: str, turn: str) -> tuple[str, str]:
    """What is seen of all neighbours, as one vector, and whether all that counts is finite."""
    k = len(role["neighbours"])
    there = g.op("Greater", "present", g.constant(0.5))
    there = g.op("Reshape", there, g.constant([k, 1], np.int64))
    heard = g.op("Where", there, "neighbours", g.constant(0.0))
    sees = g.finite(heard)
    back = g.op("Transpose", turn, perm=[1, 0])
    pair = lambda a: g.op(
        "Slice", heard, *(g.constant([v], np.int64) for v in (a, a + 2)), g.constant([1], np.int64)
    )
    gap = g.op("Add", g.op("Sub", pair(0), here), g.constant(np.reshape(role["shift"], (k, 2))))
    gap = g.op("MatMul", gap, back)
    rows = [g.constant(np.ones((k, 1))), gap, _magnified(g, gap, sight["scale"], 1)]
    rows += [g.op("MatMul", pair(at), back) for at in range(2, sight["message"], 2)]
    seen = g.op("Where", there, g.op("Concat", *rows, axis=1), g.constant(0.0))
    return g.op("Reshape", seen, g.constant([-1], np.int64)), sees
