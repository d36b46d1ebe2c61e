"""The target of an untextured material as curves over cos(theta_i), so that rendering does not run the network."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nma import network
from nma.adapter import Adapter, encoding
from nma.jit import dr
from nma.ops import Float, Vec3, at_azimuth_0
from nma.target.brdf import Brdf
from nma.target.decode import numbers

# The number of nodes, that is, of cosines for which the blend is stored. For random materials in the training range,
# the curves changed BRDF values by 1e-4 on average, at directions sampled from the blend, and albedos by 1e-5. Nodes
# that lie closer together at grazing angles gave about the same errors.
NODES = 128
# The count of numbers that one gather fetches. Dr.Jit can fetch a block of numbers at once if the length of the block
# is a power of two, so 24 numbers need three gathers of 8.
PACKET = 8
# Cosines smaller than MIN_COS are replaced by MIN_COS, so that no adapter is evaluated exactly at the horizon.
MIN_COS = 1e-4


class Curves:
    """The numbers that describe a blend (`nma.target.numbers`), stored for fixed cosines and linearly interpolated
    between these nodes.

    With curves, rendering does not call `Adapter.prepare`. Only `update` runs the network, once for each node.

    Every interpolated list of numbers describes a valid blend. The numbers do not include `Blend.scale`, so
    `Adapter.from_numbers` computes the scale of a bounded blend again at each lookup. Derivatives with respect to the
    material's parameters come from tables of slopes, because neither forward derivatives nor frozen functions of Dr.Jit
    could trace the computation of the curves.
    """

    # Frozen functions of Dr.Jit look for variables in these fields.
    DRJIT_STRUCT = {"table": object, "slopes": dict, "layers": list}  # noqa: RUF012

    def __init__(self, adapter: Adapter, columns: Sequence[Float], nodes: int = NODES):
        """
        Args:
            adapter: the adapter whose network computes the curves.
            columns: `mi.Float` of width 1 for each column of the class's parameter vector.
            nodes: number of nodes; two nodes are used if the target does not depend on the direction.

        Raises `ParamError` for anisotropic adapters.
        """
        adapter.check_isotropic()
        mi = _mitsuba()
        self.adapter = adapter
        self.nodes = nodes if adapter.directional else 2
        self.packets = -(-adapter.size // PACKET)
        self.layers = [(mi.TensorXf(matrix), mi.TensorXf(bias)) for matrix, bias in adapter.layers]
        self.update(columns)

    def update(self, columns: Sequence[Float]) -> None:
        """Computes the curves again for changed parameters. Dr.Jit reuses the kernels if only the values changed."""
        self.table = self._tabulated([dr.detach(column) for column in columns])
        dr.eval(self.table)
        self.slopes = {
            k: self._slope(columns, k) for k, column in enumerate(columns) if dr.grad_enabled(column)
        }

    def at(self, wi: Vec3, columns: Sequence[Float], active: Any = True) -> Brdf:
        """The BRDF for the view direction `wi`. `columns`, the parameters for which the curves were computed, are
        needed only for derivatives."""
        flat = self._looked_up(self.table, wi.z, active)
        for k, slope in self.slopes.items():
            if dr.grad_enabled(columns[k]):
                # The value of `change` is 0, but its derivative is that of columns[k].
                change = columns[k] - dr.detach(columns[k])
                steps = self._looked_up(slope, wi.z, active)
                flat = [number + step * change for number, step in zip(flat, steps, strict=True)]
        return self.adapter.from_numbers(flat, wi)

    def _tabulated(self, columns: Sequence[Float]) -> Float:
        """The numbers of all nodes, one node after another. The numbers of each node are padded with zeros to whole
        packets."""
        cosines = dr.maximum(dr.linspace(_mitsuba().Float, 0.0, 1.0, self.nodes), MIN_COS)
        made = _prepare(self.adapter, self.layers, columns, at_azimuth_0(cosines))
        flat = numbers(made.blend, self.adapter.target)
        return _interleaved(flat + [0.0] * (self.packets * PACKET - self.adapter.size), self.nodes)

    def _slope(self, columns: Sequence[Float], k: int) -> Float:
        """The derivative of the table with respect to column `k`."""
        mi = _mitsuba()
        columns = [mi.Float(dr.detach(column)) for column in columns]
        dr.enable_grad(columns[k])
        dr.set_grad(columns[k], 1.0)
        slope = dr.forward_to(self._tabulated(columns))
        dr.eval(slope)
        return slope

    def _looked_up(self, table: Float, cos_theta_i: Float, active: Any) -> list[Float]:
        """The numbers of a table, interpolated at cos(theta_i)."""
        mi = _mitsuba()
        position = dr.clip(cos_theta_i, 0.0, 1.0) * (self.nodes - 1)
        left = dr.minimum(mi.UInt32(position), self.nodes - 2)
        t = position - mi.Float(left)
        flat = []
        for packet in range(self.packets):
            index = left * self.packets + packet
            ends = [self._gather(table, index + step * self.packets, active) for step in (0, 1)]
            flat += [dr.lerp(a, b, t) for a, b in zip(*ends, strict=True)]
        return flat[: self.adapter.size]

    @staticmethod
    def _gather(table: Float, index: Any, active: Any) -> Any:
        return dr.gather(_mitsuba().ArrayXf, table, index, active, shape=(PACKET, dr.width(index)))


def _prepare(adapter: Adapter, layers: list[Any], columns: Sequence[Float], wi: Vec3) -> Brdf:
    """`Adapter.prepare` with matrix products: a few small kernels, which compile faster than one large kernel."""
    mi = _mitsuba()
    inputs = encoding.get(adapter.encoding)(columns, wi if adapter.directional else None)
    x = mi.TensorXf(_interleaved(inputs, dr.width(wi.z)), (dr.width(wi.z), len(inputs)))
    raw = network.forward(layers, x)
    return adapter.decode([raw[:, k].array for k in range(adapter.outputs)], wi, columns)


def _interleaved(values: Sequence[Float], width: int) -> Float:
    """One array that contains the first entries of all `values`, then the second entries, and so on. A scalar counts as
    an array of `width` equal entries."""
    mi = _mitsuba()
    return dr.ravel(mi.ArrayXf([mi.Float(value) + dr.zeros(mi.Float, width) for value in values]))


def _mitsuba() -> Any:
    """The module `mitsuba`, typed as Any because its types change with the variant."""
    import mitsuba

    return mitsuba
