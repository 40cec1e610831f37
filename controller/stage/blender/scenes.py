"""The scenes that come with Velatura. Runs inside Blender's own Python, beside ``worker.py``; imports nothing of ours.

A scene gets the object as a camera sees it: metres, z up, the first camera at the origin looking along y. It gives it
a material and lights it; all sizes follow the object's own, from ``low`` to ``high``. The object is solid: behind what
the camera sees lies a back.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import bpy
from mathutils import Vector

COLOURS = "reflectance"
"""Name of the vertex colours: the object's own paint, linear."""


def marble(body: Any, low: Any, high: Any) -> None:
    """White marble with grey veins; light goes some way inside (Christensen and Burley's random walk)."""
    nodes, links, surface = _material(body, "marble")
    size = float(max(high - low))
    place = nodes.new("ShaderNodeTexCoord")
    bends = nodes.new("ShaderNodeTexNoise")
    bends.inputs["Scale"].default_value = 6.0 / size
    bends.inputs["Detail"].default_value = 8.0
    bent = nodes.new("ShaderNodeMixRGB")
    bent.inputs["Fac"].default_value = 0.35 * size
    veins = nodes.new("ShaderNodeTexWave")
    veins.inputs["Scale"].default_value = 1.6 / size
    veins.inputs["Distortion"].default_value = 9.0
    veins.inputs["Detail"].default_value = 6.0
    ramp = nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].color = (0.27, 0.28, 0.30, 1)
    ramp.color_ramp.elements[0].position = 0.02
    ramp.color_ramp.elements[1].color = (0.88, 0.86, 0.82, 1)
    ramp.color_ramp.elements[1].position = 0.35
    links.new(place.outputs["Object"], bends.inputs["Vector"])
    links.new(place.outputs["Object"], bent.inputs["Color1"])
    links.new(bends.outputs["Color"], bent.inputs["Color2"])
    links.new(bent.outputs["Color"], veins.inputs["Vector"])
    links.new(veins.outputs["Fac"], ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], surface.inputs["Base Color"])
    surface.inputs["Subsurface Weight"].default_value = 1.0
    surface.inputs["Subsurface Scale"].default_value = 0.04 * size
    surface.inputs["Subsurface Radius"].default_value = (1.0, 0.7, 0.5)
    surface.inputs["Roughness"].default_value = 0.25
    _studio(low, high, ambient=0.25)


def gold(body: Any, low: Any, high: Any) -> None:
    """Polished gold in a bright room, with the object mirrored in itself."""
    _, _, surface = _material(body, "gold")
    surface.inputs["Base Color"].default_value = (1.0, 0.66, 0.24, 1)
    surface.inputs["Metallic"].default_value = 1.0
    surface.inputs["Roughness"].default_value = 0.22
    _studio(low, high, ambient=0.15)
    _room()


def glazed(body: Any, low: Any, high: Any) -> None:
    """A blue glaze over white clay: the object's own relief, and a clear coat with sharp highlights."""
    nodes, links, surface = _material(body, "glaze")
    place = nodes.new("ShaderNodeTexCoord")
    spots = nodes.new("ShaderNodeTexNoise")
    spots.inputs["Scale"].default_value = 14.0 / float(max(high - low))
    spots.inputs["Detail"].default_value = 4.0
    ramp = nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].color = (0.010, 0.035, 0.22, 1)
    ramp.color_ramp.elements[0].position = 0.35
    ramp.color_ramp.elements[1].color = (0.06, 0.26, 0.62, 1)
    ramp.color_ramp.elements[1].position = 0.7
    links.new(place.outputs["Object"], spots.inputs["Vector"])
    links.new(spots.outputs["Fac"], ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], surface.inputs["Base Color"])
    surface.inputs["Roughness"].default_value = 0.5
    surface.inputs["Coat Weight"].default_value = 1.0
    surface.inputs["Coat Roughness"].default_value = 0.06
    _studio(low, high, ambient=0.3)


def lowered_head(body: Any, low: Any, high: Any) -> None:
    """The object in its own paint, its upper third bent forward: geometry that is not there."""
    nodes, links, surface = _material(body, "own paint")
    paint = nodes.new("ShaderNodeVertexColor")
    paint.layer_name = COLOURS
    links.new(paint.outputs["Color"], surface.inputs["Base Color"])
    surface.inputs["Roughness"].default_value = 0.8
    _bend_forward(body, low, high, from_height=0.62, angle=math.radians(24))
    _studio(low, high, ambient=0.35)


BUILTIN: Mapping[str, Callable[[Any, Any, Any], None]] = {
    "marble": marble,
    "gold": gold,
    "glazed": glazed,
    "lowered-head": lowered_head,
}


def _material(body: Any, name: str) -> tuple[Any, Any, Any]:
    """A new material on the object: its nodes, their links, and the node of its surface."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    body.data.materials.clear()
    body.data.materials.append(material)
    return material.node_tree.nodes, material.node_tree.links, material.node_tree.nodes["Principled BSDF"]


def _bend_forward(body: Any, low: Any, high: Any, *, from_height: float, angle: float) -> None:
    """Turn what lies above ``from_height`` (share of the height) towards the camera, over a smooth transition."""
    height = high.z - low.z
    pivot_z = low.z + from_height * height
    pivot_y = (low.y + high.y) / 2
    for vertex in body.data.vertices:
        if vertex.co.z <= pivot_z - 0.08 * height:
            continue
        share = min(max((vertex.co.z - pivot_z) / (0.16 * height) + 0.5, 0.0), 1.0)
        turned = angle * share * share * (3 - 2 * share)
        y, z = vertex.co.y - pivot_y, vertex.co.z - pivot_z
        # About the x axis; the camera looks along +y, so forward is -y.
        vertex.co.y = pivot_y + y * math.cos(turned) - z * math.sin(turned)
        vertex.co.z = pivot_z + y * math.sin(turned) + z * math.cos(turned)


def _studio(low: Any, high: Any, *, ambient: float) -> None:
    """A key light above the camera's left, a fill at its right, and some light from everywhere."""
    middle, size = (low + high) / 2, float(max(high - low))
    for name, place, extent, strength in (("key", (-1.6, -1.8, 2.0), 1.2, 1.0), ("fill", (2.2, -1.6, 0.4), 1.6, 0.25)):
        light = bpy.data.lights.new(name, "AREA")
        light.shape, light.size = "DISK", extent * size
        offset = Vector(place) * size
        # Watts for about the same light on a facing surface, whatever the object's size.
        light.energy = strength * 4.0 * math.pi * offset.length_squared
        lamp = bpy.data.objects.new(name, light)
        lamp.location = middle + offset
        lamp.rotation_euler = (-offset).to_track_quat("-Z", "Y").to_euler()
        bpy.context.scene.collection.objects.link(lamp)
    _world().inputs["Color"].default_value = (ambient, ambient, ambient, 1)


def _world() -> Any:
    world = bpy.data.worlds.new("studio")
    world.use_nodes = True
    bpy.context.scene.world = world
    return world.node_tree.nodes["Background"]


def _room() -> None:
    """A bright ceiling, pale walls and a darker floor, for what mirrors them."""
    world = bpy.context.scene.world
    nodes, links = world.node_tree.nodes, world.node_tree.links
    place = nodes.new("ShaderNodeTexCoord")
    parts = nodes.new("ShaderNodeSeparateXYZ")
    height = nodes.new("ShaderNodeMapRange")
    height.inputs["From Min"].default_value = -1.0
    ramp = nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].color = (0.16, 0.13, 0.10, 1)
    ramp.color_ramp.elements[0].position = 0.38
    ramp.color_ramp.elements[1].color = (0.95, 1.0, 1.05, 1)
    ramp.color_ramp.elements[1].position = 0.85
    wall = ramp.color_ramp.elements.new(0.55)
    wall.color = (0.55, 0.52, 0.48, 1)
    links.new(place.outputs["Generated"], parts.inputs["Vector"])
    links.new(parts.outputs["Z"], height.inputs["Value"])
    links.new(height.outputs["Result"], ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], nodes["Background"].inputs["Color"])
