"""A policy as one ONNX graph: encoder and denoiser are translated once, the sampler's chain is written around them.

Translating the whole loop gives as fast a graph, but takes torch's exporter a time in proportion to the steps: over a
minute for 100 of them, where this way it is a few seconds for any number. (The exporter that it replaces,
``dynamo=False``, is fast enough, but deprecated.)
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import onnx_ir as ir
import torch
from onnx_ir.passes.common import ClearMetadataAndDocStringPass, InlinePass, RemoveUnusedOpsetsPass
from onnxscript import opset20 as op
from torch import Tensor, nn

from redig.deploy.parts import Condition, denoiser_step
from redig.deploy.transitions import Transition, chain_transitions
from redig.modules.diffusion import DiffusionPolicy

OPSET, DOMAIN = 20, "redig"


def unroll(
    encoder: nn.Module, policy: DiffusionPolicy, name: str, width: int, stochastic: bool = False, ego: bool = False
) -> ir.Model:
    """Encoder, chain and bounds as one graph of ONNX's own operators, for any number of teams and robots.

    Args:
        encoder: from observations ``[B, n, F]`` to embeddings ``[B, n, H]``, or ``nn.Identity()``.
        policy: the denoiser with its schedule, sampler and bounds.
        name: of the input.
        width: F.
        stochastic: take the latent ``[B, n, A]`` and the noise ``[S, B, n, A]`` of the S noisy transitions as inputs.
        ego: only the action of the first robot of each team; action, latent and noise then have no n.

    Raises:
        ValueError: if the sampler has a loop of its own.

    Examples:
        >>> from redig.modules import DDPM, DenoisingMLP, NoiseSchedule
        >>> policy = DiffusionPolicy(DenoisingMLP(2, 8), NoiseSchedule(10), DDPM(3), -torch.ones(2), torch.ones(2))
        >>> model = unroll(nn.Identity(), policy, "embedding", 8, stochastic=True)
        >>> [(value.name, str(value.shape)) for value in model.graph.inputs]
        [('embedding', '[teams,robots,8]'), ('latent', '[teams,robots,2]'), ('noise', '[2,teams,robots,2]')]
    """
    transitions = chain_transitions(policy.sampler, policy.schedule, deterministic=not stochastic)
    encoder, denoiser = (copy.deepcopy(module).cpu().float() for module in (encoder, policy.denoiser))
    low, high = policy.low.cpu().float(), policy.high.cpu().float()
    step, action_dim = denoiser_step(denoiser), len(low)
    before = Condition(encoder, step, ego)
    teams = torch.zeros(2, 3, width)
    with torch.no_grad():
        rows, times = before(teams), step.times([transition.step for transition in transitions])
    team, robot, row = torch.export.Dim("teams"), torch.export.Dim("robots"), torch.export.Dim.DYNAMIC
    model = _translate(before, {name: teams}, "condition", [{0: team, 1: robot}])
    actions = rows.new_zeros(len(rows), action_dim)
    inputs = {"action": actions, "time": times[0], "condition": rows}
    writer = _Writer(model, _translate(step, inputs, "predicted", [{0: row}, None, {0: row}]), action_dim)

    condition = model.graph.outputs.pop()
    dims = ["teams"] if ego else ["teams", "robots"]
    noise = None
    if stochastic:
        latent = writer.input("latent", [*dims, action_dim])
        action = writer.op("Reshape", latent, writer.constant([-1, action_dim]))
        if sigma := [transition.sigma for transition in transitions if transition.sigma > 0]:
            noise = writer.input("noise", [len(sigma), *dims, action_dim])
            noise = writer.op("Reshape", noise, writer.constant([len(sigma), -1, action_dim]))
            noise = writer.op("Mul", noise, writer.constant(torch.tensor(sigma).reshape(-1, 1, 1)))
    else:
        length = writer.op("Shape", condition, start=0, end=1)
        shape = writer.op("Concat", length, writer.constant([action_dim]), axis=0)
        action = writer.op("ConstantOfShape", shape)  # of zeros
    action = _chain(writer, transitions, times, action, condition, noise)

    action = writer.op("Mul", writer.op("Add", action, writer.constant(1.0)), writer.constant((high - low) / 2))
    action = writer.op("Add", action, writer.constant(low))
    action = writer.op("Min", writer.op("Max", action, writer.constant(low)), writer.constant(high))
    if not ego:
        batch = writer.op("Shape", model.graph.inputs[0], start=0, end=2)
        action = writer.op("Reshape", action, writer.op("Concat", batch, writer.constant([action_dim]), axis=0))
    action.name, action.dtype, action.shape = "action", ir.DataType.FLOAT, ir.Shape([*dims, action_dim])
    model.graph.outputs.append(action)
    for tidy in (InlinePass(), ClearMetadataAndDocStringPass(), RemoveUnusedOpsetsPass()):
        tidy(model)
    return model


def _chain(
    writer: _Writer,
    transitions: Sequence[Transition],
    times: Tensor,
    action: ir.Value,
    condition: ir.Value,
    noise: ir.Value | None,
) -> ir.Value:
    """The loop of :class:`~redig.modules.Sampler`, operator by operator: actions in [-1, 1]; the noise comes scaled."""
    clean, drawn = None, 0
    for transition, time in zip(transitions, times, strict=True):
        older_clean = clean
        predicted = writer.denoise(action, writer.constant(time), condition)
        clean = writer.sum((transition.of_action, action), (transition.of_predicted, predicted))
        clean = writer.op("Clip", clean, writer.constant(-1.0), writer.constant(1.0))
        terms = [(transition.c0, clean), (transition.ck, action), (transition.c_older, older_clean)]
        if transition.sigma > 0:
            terms.append((1.0, writer.op("Gather", noise, writer.constant(torch.tensor(drawn)), axis=0)))
            drawn += 1
        action = writer.sum(*terms)
    return action


class _Writer:
    """Appends operators to a graph, among them the denoiser."""

    def __init__(self, model: ir.Model, denoiser: ir.Model, action_dim: int) -> None:
        self.graph, self.tape = model.graph, ir.tape.Tape(model.graph)
        self.constants: dict[tuple[Any, ...], ir.Value] = {}
        self.identity = self.constant(torch.eye(action_dim))
        inner = denoiser.graph
        self.weights = []
        for name, value in list(inner.initializers.items()):  # as inputs of the function, one copy serves all steps
            inner.initializers.pop(name)
            inner.inputs.append(value)
            assert value.const_value is not None
            self.weights.append(self.tape.initializer(value.const_value, f"denoiser.{name}"))
            value.const_value = None
        function = ir.Function(DOMAIN, "Denoise", graph=inner, attributes=[])
        model.functions[function.identifier()] = function
        self.graph.opset_imports[DOMAIN] = 1

    def denoise(self, action: ir.Value, time: ir.Value, condition: ir.Value) -> ir.Value:
        return self.tape.op("Denoise", [action, time, condition, *self.weights], domain=DOMAIN)

    def input(self, name: str, shape: Sequence[int | str]) -> ir.Value:
        value = ir.Value(name=name, type=ir.TensorType(ir.DataType.FLOAT), shape=ir.Shape(shape))
        self.graph.inputs.append(value)
        return value

    def op(self, kind: str, *inputs: ir.Value | None, **attributes: Any) -> ir.Value:
        return self.tape.op(kind, inputs, attributes)

    def constant(self, value: float | Sequence[int] | Tensor) -> ir.Value:
        if isinstance(value, float):
            value = torch.tensor(value)
        array = np.asarray(value)
        key = array.dtype, array.shape, array.tobytes()
        if key not in self.constants:
            self.constants[key] = self.tape.initializer(ir.tensor(array), f"constant_{len(self.constants)}")
        return self.constants[key]

    def sum(self, *terms: tuple[float, ir.Value | None]) -> ir.Value:
        """Sum of actions times their factors; a term whose factor is 0 is left out.

        ``alpha x I + beta y`` is one operator, Gemm, in place of three: at this size, calling them is what takes time.
        """
        (factor, total), *rest = [term for term in terms if term[0]]
        for alpha, value in rest:
            total = self.op("Gemm", value, self.identity, total, alpha=alpha, beta=factor)
            factor = 1.0
        return self.op("Mul", total, self.constant(factor)) if factor != 1 else cast(ir.Value, total)


def _translate(module: nn.Module, inputs: dict[str, Tensor], output: str, dynamic: list[Any]) -> ir.Model:
    program = torch.onnx.export(
        module.eval(),
        tuple(inputs.values()),
        input_names=list(inputs),
        output_names=[output],
        opset_version=OPSET,
        dynamo=True,
        dynamic_shapes=dynamic,
        custom_translation_table={torch.ops.aten.mish.default: _mish},
        verbose=False,
    )
    assert program is not None
    return program.model


def _mish(x: Any) -> Any:
    """``x tanh(log(1 + e^x))`` with one exponential: a sixth of ONNX Runtime's time for its operator of that name."""
    e = op.Exp(op.Min(x, op.Constant(value_float=20.0)))  # e^20 + 2 is e^20 in float32, and e^40 does not overflow
    two = op.Constant(value_float=2.0)
    n = op.Mul(e, op.Add(e, two))
    return op.Mul(x, op.Div(n, op.Add(n, two)))
