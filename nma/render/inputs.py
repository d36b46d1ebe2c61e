"""The parameters of a material as inputs of a Mitsuba BSDF: numbers, colours or textures, which are checked when the
scene is loaded."""

from __future__ import annotations

from typing import Any

import numpy as np

from nma import materials
from nma.adapter import Adapter
from nma.errors import ParamError, TextureError, either
from nma.images.io import COLOUR
from nma.params import MEASURED, Param, ParamSpace, Range
from nma.render.input_checks import Allowed, check_numbers, check_texture
from nma.render.paths import scene_path
from nma.render.textures import bitmap_texture


class Inputs:
    """The parameters of a class, read from a BSDF's properties.

    Each parameter has a property of the same name. Numbers and colours are linear and may lie outside 0 .. 1, because
    some are refractive indices, not reflectances. Textures with values outside 0 .. 1 need `raw`. The property
    `NAME_channel` ("r", "g" or "b") chooses the channel of a coloured texture for a parameter of one number. The
    property `material` is the name of a shipped material or a `.toml` file. The values of this material are used for
    the parameters that are not given.

    `values` maps the name of each parameter to a `mi.Float` (size 1), a `mi.Color3f` (size 3) or a `mi.Texture`.
    Numbers and pixels must be finite and within `bounds`; with `clamp`, finite values are clamped to the bounds
    instead. Values that are not known before rendering (mesh attributes, edits inside frozen functions) are always
    clamped.

    Kernels read the numbers from memory, so an edit does not cause a recompilation, and materials with the same
    textured parameters share a kernel.
    """

    # Frozen functions of Dr.Jit look for variables in these fields.
    DRJIT_STRUCT = {"values": dict}  # noqa: RUF012

    def __init__(self, space: ParamSpace, props: Any, bounds: Range = "valid", clamp: bool = False):
        self.space, self.bounds, self.clamp = space, bounds, clamp
        given: dict[str, Any] = {}
        if "material" in props:
            given |= _material_values(_setting(props, "material", ""), space)
        given |= {param.name: _read(param, props) for param in space.params if param.name in props}
        missing = [param.name for param in space.params if param.name not in given]
        if missing:
            raise ParamError(
                f"class {space.name}: no value for {', '.join(missing)}; give each parameter a number, a colour "
                "or a texture, or name a `material` that has them (`nma materials` lists the shipped materials)"
            )
        self.values = {param.name: _value(param, given[param.name]) for param in space.params}
        self.chosen = {param.name: _channel(param, props, self.values[param.name]) for param in space.params}
        self._seen = {name: _Seen(value) for name, value in self.values.items()}
        self.check(numbers=True)

    @property
    def textured(self) -> tuple[str, ...]:
        """The names of the parameters whose values come from textures."""
        import mitsuba as mi

        return tuple(name for name, value in self.values.items() if isinstance(value, mi.Texture))

    def columns(self, si: Any = None, active: Any = True) -> list[Any]:
        """One `mi.Float` for each column of the class's parameter vector, at the surface interaction `si`.

        Without textures `si` is not needed. Derivatives are propagated to numbers, colours and textures.
        """
        return [channel for param in self.space.params for channel in self.channels(param.name, si, active)]

    def channels(self, name: str, si: Any = None, active: Any = True) -> list[Any]:
        """The one or three channels of a parameter, clamped to its bounds."""
        import mitsuba as mi

        param, value = self.space[name], self.values[name]
        if isinstance(value, mi.Texture):
            value = value.eval(si, active)
            channels = [value.x, value.y, value.z]
            channels = channels if param.size == 3 else [channels[self.chosen[name] or 0]]
        else:
            channels = [value] if param.size == 1 else [value.x, value.y, value.z]
        return [param.bounds(self.bounds).moved(c) for c in channels]

    def traverse(self, callback: Any, differentiable: bool) -> None:
        """Passes every input, by its name, to the `callback` of `mi.traverse`."""
        import mitsuba as mi

        flags = mi.ParamFlags.Differentiable if differentiable else mi.ParamFlags.NonDifferentiable
        for name, value in self.values.items():
            callback.put(name, value, flags)

    def __str__(self) -> str:
        return ",\n".join(f"  {name} = {value}".replace("\n", "\n  ") for name, value in self.values.items())

    def check(self, numbers: bool = False) -> None:
        """Checks the textures, and with `numbers` all inputs, that have changed since the last check.

        For a bad value, restores the last good value, and raises `ParamError` or `TextureError`. A bad value must not
        stay, because Dr.Jit records all existing BSDFs into its kernels, so the error would also stop the rendering of
        other scenes.

        BSDFs call this method wherever they use inputs, because Mitsuba does not report edits of a texture that several
        BSDFs share. While Dr.Jit records a frozen function, values cannot be read, so edited values are clamped to the
        bounds instead.
        """
        import drjit as dr

        if dr.flag(dr.JitFlag.FreezingScope):
            return
        textured = self.textured
        faults = [self._fault(param) for param in self.space.params if numbers or param.name in textured]
        for fault in filter(None, faults):
            raise fault

    def _fault(self, param: Param) -> ParamError | TextureError | None:
        """The error of an input if its value has changed and is not allowed, else None. A bad value is replaced by the
        last good value."""
        import mitsuba as mi

        seen, value = self._seen[param.name], self.values[param.name]
        if not seen.changed():
            return None
        allowed = Allowed(param, self.bounds, self.clamp)
        try:
            if isinstance(value, mi.Texture):
                check_texture(allowed, value, seen.leaves(), self.chosen[param.name])
            else:
                check_numbers(allowed, value)
        except (ParamError, TextureError) as error:
            seen.put_back()
            return error
        seen.remember()
        return None

    def changed(self) -> None:
        """Checks all inputs after edits, and raises the errors that `check` raises."""
        import drjit as dr
        import mitsuba as mi

        for value in self.values.values():
            if not isinstance(value, mi.Texture):
                # Mitsuba stores edited numbers as literals, which would be compiled into the kernel.
                dr.make_opaque(value)
        self.check(numbers=True)


def of_adapter(adapter: Adapter, props: Any) -> Inputs:
    """The inputs of an adapter: the parameters of its class, or no inputs for an adapter of a single material.

    Raises `ParamError` if parameters of another material are given to an adapter of a single material.
    """
    import mitsuba as mi

    clamp, known = _setting(props, "clamp", False), adapter.material
    if known is None:
        return Inputs(adapter.space, props, "training", clamp)
    given = _material_values(_setting(props, "material", ""), adapter.space) if "material" in props else {}
    given |= {param.name: _read(param, props) for param in adapter.space.params if param.name in props}
    for name, value in given.items():
        if isinstance(value, mi.Texture):
            raise ParamError(
                f"the adapter was trained for a single material, so {name} cannot be textured; leave {name} out"
            )
        whole = known.copy()
        whole[adapter.space.slices[name]] = value
        adapter.check(whole)
    # The network of this adapter reads only the direction, so the BSDF has no inputs. MEASURED is the class that has no
    # parameters, whatever the class of the adapter's material is.
    return Inputs(MEASURED, {}, "training")


class _Seen:
    """The arrays of an input: the current arrays, and the arrays that were checked last.

    Changes are detected by the indices of Dr.Jit's variables. The checked arrays are kept alive, because Dr.Jit reuses
    the index of a variable that is freed.
    """

    def __init__(self, value: Any):
        import mitsuba as mi

        self._number = None if isinstance(value, mi.Texture) else value
        self._params: Any = mi.traverse(value) if self._number is None else {}
        self._names = [key for key, _ in self._params.items() if _known(key)]
        self._checked: list[Any] | None = None

    def leaves(self) -> list[Any]:
        """The current arrays of pixels and numbers."""
        if self._number is not None:
            return [self._number]
        return [self._params[name] for name in self._names]

    def changed(self) -> bool:
        return self._checked is None or _indices(self._checked) != _indices(self.leaves())

    def remember(self) -> None:
        import drjit as dr

        leaves = self.leaves()
        for leaf in leaves:
            dr.make_opaque(leaf)
        self._checked = [type(leaf)(dr.detach(leaf)) for leaf in leaves]

    def put_back(self) -> None:
        """Restores the arrays that were checked last, if there are any."""
        import mitsuba

        mi: Any = mitsuba  # Mitsuba's type stubs lack this function
        if self._checked is None:
            return
        if self._number is not None:
            mi.set_property(self._number, self._checked[0])
            return
        for name, leaf in zip(self._names, self._checked, strict=True):
            self._params[name] = leaf
        self._params.update()


def _known(key: str) -> bool:
    """Whether `key` is a key of `mi.traverse` for the pixels or the value of a texture."""
    return key.rpartition(".")[2] in ("data", "value")


def _indices(values: list[Any]) -> list[int]:
    """The indices of the arrays' Dr.Jit variables, without the indices of their derivatives."""
    import drjit as dr

    return [index & 0xFFFFFFFF for index in dr.detail.collect_indices(values)]


def _value(param: Param, given: Any) -> Any:
    """Converts an input to a `mi.Float`, a `mi.Color3f` or a `mi.Texture`."""
    import drjit as dr
    import mitsuba as mi

    if isinstance(given, mi.Texture):
        return given
    numbers = list(given) if isinstance(given, (list, tuple)) else [given]
    value = (
        mi.Float(float(numbers[0]))
        if param.size == 1
        else mi.Color3f(numbers if len(numbers) > 1 else numbers[0])
    )
    dr.make_opaque(value)
    return value


def _read(param: Param, props: Any) -> Any:
    """Reads a property as a number, a list of numbers, or a texture."""
    import mitsuba as mi

    kinds: Any = mi.Properties.Type
    kind = props.type(param.name)
    value = props[param.name]
    if kind == kinds.Spectrum:
        return _numbers(param, _constant(props.get_unbounded_texture(param.name)))
    if isinstance(value, mi.Texture):
        return value
    if kind in (kinds.Float, kinds.Integer):
        return float(value)
    if kind in (kinds.Color, kinds.Vector):
        return _numbers(param, [float(value[i]) for i in range(3)])
    wanted = "a number, a texture" if param.size == 1 else "a number, a colour (rgb), a texture"
    raise ParamError(f"{param.name} needs {wanted}, got {str(kind).rpartition('.')[2].lower()} {value!r}")


def _numbers(param: Param, channels: Any) -> Any:
    """The value of a parameter from the channels of a colour. A parameter of one number accepts a colour only if the
    colour is grey, that is, if its channels are equal."""
    if not isinstance(channels, list) or param.size == 3:
        return channels
    if len(set(channels)) > 1:
        colour = ", ".join(f"{x:g}" for x in channels)
        raise ParamError(f"{param.name} needs one number or a texture, got the colour {colour}")
    return channels[:1]


def _constant(texture: Any) -> Any:
    """The channels of a constant texture as a list; any other texture unchanged."""
    import mitsuba as mi

    params = mi.traverse(texture)
    if texture.is_spatially_varying() or "value" not in params:
        return texture
    return [float(channel) for channel in np.ravel(params["value"])]


def _channel(param: Param, props: Any, value: Any) -> int | None:
    """The index of the texture channel chosen for a parameter of one number; None if none is chosen."""
    import mitsuba as mi

    name = f"{param.name}_channel"
    if name not in props:
        return None
    wanted = props[name]
    if param.size > 1 or not isinstance(value, mi.Texture):
        fault = "more than one number" if isinstance(value, mi.Texture) else "no texture"
        raise ParamError(
            f"{name} chooses a channel of a texture, but {param.name} has {fault}; leave {name} out"
        )
    if wanted not in COLOUR:
        raise ParamError(f"{name} is {wanted!r}; choose {either(COLOUR)}")
    return COLOUR.index(wanted)


def _setting(props: Any, name: str, default: Any) -> Any:
    """Reads a property that is not a parameter. The property must have the type of `default`, or else the text "false"
    would count as true."""
    value = props.get(name, default)
    if not isinstance(value, type(default)):
        wanted = "true or false (boolean)" if isinstance(default, bool) else "a name (string)"
        raise ParamError(f"{name} needs {wanted}, got {value!r}")
    return value


def _material_values(name: str, space: ParamSpace) -> dict[str, Any]:
    """The parameters of a named material. Textures of the material are converted to Mitsuba textures."""
    import mitsuba

    mi: Any = mitsuba  # Mitsuba's types change with the variant
    material = materials.load(scene_path(name) if name.endswith(".toml") else name)
    if material.class_name != space.name:
        raise ParamError(
            f"material '{name}' is of class {material.class_name}, but this BSDF needs class {space.name}; "
            f"choose a material of class {space.name}, or an adapter of class {material.class_name}"
        )
    return {
        key: mi.load_dict(bitmap_texture(value.read(), scale=value.uv_scale))
        if isinstance(value, materials.Texture)
        else value
        for key, value in material.values.items()
    }
