"""Source parameters as the inputs of a Mitsuba BSDF: numbers, colours or textures, checked when they are loaded."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma import materials, ops
from nma.adapter import Adapter
from nma.errors import ParamError, TextureError
from nma.params import MEASURED, Bounds, Param, ParamSpace
from nma.render.scene import bitmap_texture


class Inputs:
    """The parameters of a class, read from a BSDF's properties.

    A property has a parameter's name. A number or a colour is taken as it is, unbounded and linear, since refractive
    indices are no reflectances; textures that hold such numbers want `raw`. The property `material` names a material
    (shipped, or a `.toml` file) whose values fill in for the parameters that are not given.

    `values` maps each name to a `mi.Float` (size 1), a `mi.Color3f` (size 3) or a `mi.Texture`. Numbers and pixels must
    be finite and within `bounds`; with `clamp` they are moved there instead. What a texture only knows while rendering
    (mesh attributes) is moved there always.
    """

    def __init__(self, space: ParamSpace, props: Any, bounds: Bounds = "valid", clamp: bool = False):
        self.space, self.bounds, self.clamp = space, bounds, clamp
        given: dict[str, Any] = {}
        if "material" in props:
            given |= _material_values(props["material"], space)
        given |= {param.name: _read(param, props) for param in space.params if param.name in props}
        missing = [param.name for param in space.params if param.name not in given]
        if missing:
            raise ParamError(
                f"class {space.name}: no value for {', '.join(missing)}; give each a number, a colour or a texture, "
                "or name a `material` that has them (`nma materials` lists those shipped)"
            )
        self.values = {param.name: self._checked(param, given[param.name]) for param in space.params}

    @property
    def textured(self) -> tuple[str, ...]:
        """Names of the parameters that a texture drives."""
        import mitsuba as mi

        return tuple(name for name, value in self.values.items() if isinstance(value, mi.Texture))

    def columns(self, si: Any = None, active: Any = True) -> list[Any]:
        """One `mi.Float` for each column of the class's parameter vector, at the surface interaction `si`.

        Without textures `si` is not needed. Gradients reach numbers, colours and textures.
        """
        out = []
        for param in self.space.params:
            value = self.values[param.name]
            if param.name in self.textured:
                value = value.eval(si, active)
                channels = [value.x, value.y, value.z][: param.size]
            else:
                channels = [value] if param.size == 1 else [value.x, value.y, value.z]
            if param.name in self._moved:
                channels = [ops.clip(c, *_finite(param.bounds(self.bounds))) for c in channels]
            out += channels
        return out

    def traverse(self, callback: Any, flags: Any = None) -> None:
        """Shows every input to `mi.traverse` under its name; differentiable unless `flags` say otherwise."""
        import mitsuba as mi

        for name, value in self.values.items():
            callback.put(name, value, mi.ParamFlags.Differentiable if flags is None else flags)

    def __str__(self) -> str:
        return ",\n".join(f"  {name} = {value}".replace("\n", "\n  ") for name, value in self.values.items())

    _moved: frozenset[str] = frozenset()

    def check(self, names: Iterable[str] = ()) -> None:
        """Checks inputs again after they were changed in place: those that `names` start with, or all without names."""
        import mitsuba as mi

        chosen = {name.partition(".")[0] for name in names}
        for param in self.space.params:
            value = self.values[param.name]
            if chosen and param.name not in chosen:
                continue
            if isinstance(value, mi.Texture):
                _check_texture(param, value, self.bounds, self.clamp)
            else:
                _check_numbers(param, value, self.bounds, self.clamp)

    def _checked(self, param: Param, value: Any) -> Any:
        """The input, within bounds, in the form of `values`."""
        import mitsuba as mi

        if self.clamp:
            self._moved |= {param.name}
        if isinstance(value, mi.Texture):
            if not _check_texture(param, value, self.bounds, self.clamp):
                self._moved |= {param.name}
            return value
        numbers = _check_numbers(param, value, self.bounds, self.clamp).tolist()
        return mi.Float(numbers[0]) if param.size == 1 else mi.Color3f(numbers)


def of_adapter(adapter: Adapter, props: Any) -> Inputs:
    """The inputs that an adapter has: the parameters of its class, or none where it knows a single material.

    Parameters that are given all the same must be that material's. Raises `ParamError`.
    """
    clamp, known = props.get("clamp", False), adapter.material
    if known is None:
        return Inputs(adapter.space, props, "training", clamp)
    given = _material_values(props["material"], adapter.space) if "material" in props else {}
    given |= {param.name: _read(param, props) for param in adapter.space.params if param.name in props}
    for param in adapter.space.params:
        if param.name in given:
            columns, value = adapter.space.slices[param.name], given[param.name]
            adapter.check([*known[: columns.start], *_numbers(param, value), *known[columns.stop :]])
    return Inputs(MEASURED, {}, "training")


def _numbers(param: Param, value: Any) -> NDArray:
    """A parameter's numbers; textures, which adapters of a single material do not look at, are refused."""
    import mitsuba as mi

    if isinstance(value, mi.Texture):
        raise ParamError(
            f"the adapter knows a single material, so that no texture can drive {param.name}; leave it out"
        )
    return _check_numbers(param, value, "valid", False)


def _read(param: Param, props: Any) -> Any:
    """A property as a number, three numbers, or a texture."""
    import mitsuba as mi

    kinds: Any = mi.Properties.Type
    kind = props.type(param.name)
    value = props[param.name]
    if kind == kinds.Spectrum:
        value = props.get_unbounded_texture(param.name)
    if isinstance(value, mi.Texture):
        return _constant(value)
    if kind in (kinds.Float, kinds.Integer):
        return float(value)
    if kind in (kinds.Color, kinds.Vector):
        channels = [float(value[i]) for i in range(3)]
        if param.size == 1 and len(set(channels)) > 1:
            raise ParamError(f"{param.name} wants one number or a texture, got the colour {_plain(channels)}")
        return channels[: param.size]
    wanted = "a number, a texture" if param.size == 1 else "a number, a colour (rgb), a texture"
    raise ParamError(f"{param.name} wants {wanted}, got {str(kind).rpartition('.')[2].lower()} {value!r}")


def _constant(texture: Any) -> Any:
    """The number or colour of a texture that is the same everywhere, or the texture itself."""
    import mitsuba as mi

    params = mi.traverse(texture)
    if texture.is_spatially_varying() or "value" not in params:
        return texture
    return [float(channel) for channel in np.ravel(params["value"])]


def _check_numbers(param: Param, value: Any, bounds: Bounds, clamp: bool) -> NDArray:
    """The parameter's numbers, within bounds."""
    numbers = np.asarray(value, np.float64).ravel()
    numbers = np.broadcast_to(numbers, param.size) if numbers.size == 1 else numbers
    low, high = param.bounds(bounds)
    slack = 1e-6 * max(abs(low), 1.0)
    inside = np.isfinite(numbers) & (clamp | ((numbers >= low - slack) & (numbers <= high + slack)))
    if numbers.size != param.size:
        raise ParamError(f"{param.name} wants {param.size} number(s), got {numbers.size}")
    if not inside.all():
        raise ParamError(f"{param.name} is {_plain(numbers)}, allowed is {_range(param, bounds)}")
    return np.clip(numbers, low, high)


def _check_texture(param: Param, texture: Any, bounds: Bounds, clamp: bool) -> bool:
    """Checks all numbers that a texture is made of; False if it shows none before it is rendered."""
    import mitsuba as mi

    found = [value for key, value in mi.traverse(texture) if key.rpartition(".")[2] in ("data", "value")]
    for values in map(np.array, found):
        _check_pixels(param, _decoded(values, texture), bounds, clamp, texture.id())
    return bool(found)


def _decoded(pixels: NDArray, texture: Any) -> NDArray:
    """The numbers that the texture evaluates to: Mitsuba keeps pixels of 8-bit files as bytes, sRGB unless `raw`."""
    if pixels.dtype != np.uint8:
        return pixels
    unit = pixels / 255.0
    if "raw = 1" in str(texture):
        return unit
    return np.where(unit <= 0.04045, unit / 12.92, ((unit + 0.055) / 1.055) ** 2.4)


def _check_pixels(param: Param, pixels: NDArray, bounds: Bounds, clamp: bool, name: str) -> None:
    where = f"the texture of {param.name}" + (f" ({name})" if name else "")
    low, high = param.bounds(bounds)
    slack = 1e-6 * max(abs(low), 1.0)
    bad = ~np.isfinite(pixels)
    if not clamp:
        bad |= ~((pixels >= low - slack) & (pixels <= high + slack))
    if bad.any():
        first = np.argwhere(bad)[0]
        place = f" at x={first[1]}, y={first[0]}" if pixels.ndim == 3 else ""
        raise TextureError(
            f"{where} holds {pixels[tuple(first)]}{place}, one of {bad.sum()} such values of {bad.size}; "
            f"allowed is {_range(param, bounds)}"
        )
    if param.size == 1 and pixels.ndim == 3 and np.ptp(pixels, axis=-1).max() > 1e-6:
        raise TextureError(f"{where} is coloured; a grey one is wanted, for one number per pixel")


def _material_values(name: str, space: ParamSpace) -> dict[str, Any]:
    """A named material's values; its textures as Mitsuba's."""
    import mitsuba

    mi: Any = mitsuba  # its types change with the variant

    # Files lie beside the scene, as those of Mitsuba's own plugins do.
    found = mi.file_resolver().resolve(name) if name.endswith(".toml") else name
    material = materials.load(str(found))
    if material.class_name != space.name:
        raise ParamError(f"material '{name}' is of class {material.class_name}, wanted is {space.name}")
    return {
        key: mi.load_dict(bitmap_texture(value.read(), scale=value.uv_scale))
        if isinstance(value, materials.Texture)
        else value
        for key, value in material.values.items()
    }


def _range(param: Param, bounds: Bounds) -> str:
    low, high = param.bounds(bounds)
    hint = (
        ", the range that the adapter was trained on; set `clamp` to move it there"
        if bounds == "training"
        else ""
    )
    return f"{low:g} .. {high:g}" + hint


def _finite(bounds: tuple[float, float]) -> tuple[float, float]:
    return bounds[0], min(bounds[1], 1e30)


def _plain(numbers: Any) -> str:
    return ", ".join(f"{x:g}" for x in numbers)
