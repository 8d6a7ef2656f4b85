"""Small whole files of every format that worlds are made of, and who reads each: what mutants are
made of."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import PIL.Image

from scenes import mesh_files, robots, textures, tum, worlds
from scenes.robots.page import read_own
from tests.hostile.seeds_events import Seed, buffered

LIGHT = np.random.default_rng(0).uniform(0, 255, (6, 12, 3)).astype(np.uint8)
POSES = "0,0,0,0,0,0,0,1\n0.5,1,0,0,0,0,0.6,0.8\n1.5,1,2,0,0,0,0,1\n"
URDF = """<robot name="r"><material name="red"><color rgba="0.8 0.1 0.1 1"/></material>
<link name="base"><visual><geometry><box size="0.4 0.3 0.1"/></geometry><material name="red"/></visual></link>
<link name="mast"><visual><origin xyz="0 0 0.2" rpy="0 0.1 0"/><geometry><cylinder radius="0.02" length="0.4"/>
</geometry></visual></link><link name="eye"><collision><geometry><sphere radius="0.05"/></geometry></collision></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="mast"/><axis xyz="0 0 1"/>
<origin xyz="0 0 0.05" rpy="0 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="nod" type="continuous"><parent link="mast"/><child link="eye"/><axis xyz="0 1 0"/>
<mimic joint="turn" multiplier="0.5" offset="0.1"/></joint></robot>"""
XML = """<scene version="3.0.0"><default name="bright" value="2"/><integrator type="path"/>
<sensor type="perspective"><float name="fov" value="50"/><transform name="to_world">
<lookat origin="1.5, 2, 4" target="0.2, 0.5, 0" up="0, 1, 0"/></transform>
<film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="16"/></film></sensor>
<bsdf type="twosided" id="m"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
<string name="filename" value="brick.png"/></texture></bsdf></bsdf>
<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="2"/></transform><ref id="m"/></shape>
<shape type="sphere"><point name="center" x="0" y="0.6" z="0"/><float name="radius" value="0.5"/>
<bsdf type="principled"><rgb name="base_color" value="0.8, 0.3, 0.2"/></bsdf></shape>
<shape type="ply"><string name="filename" value="mesh.ply"/><emitter type="area"><rgb name="radiance" value="1"/></emitter></shape>
<emitter type="constant"><rgb name="radiance" value="$bright"/></emitter></scene>"""
PAGE = """robot: rover.obj
without: [wheel]
camera:
  low_m: [0.1, -0.1, 0.4]
  high_m: [0.3, 0.1, 0.6]
  pitch_deg: [0, 60]
start:
  pitch_deg: 20
lens:
  fno: 1.4
velocities: planar
"""


def picture(kind: str) -> Callable[[], bytes]:
    """A picture that Pillow writes."""
    return buffered(lambda buffer: PIL.Image.fromarray(LIGHT).save(buffer, kind))


def hdr() -> bytes:
    """Radiance RGBE with run lengths of the newer kind: a run and literal bytes in every
    channel."""
    rgbe = np.concatenate([LIGHT, np.full((6, 12, 1), 130, np.uint8)], 2)
    rgbe[:, :5] = 77
    rows = b"".join(
        b"\x02\x02"
        + struct.pack(">H", 12)
        + b"".join(bytes([133, 77, 7, *row[5:, k]]) for k in range(4))
        for row in rgbe
    )
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=1\n\n-Y 6 +X 12\n" + rows


def exr() -> bytes:
    """What Mitsuba writes."""
    from codesign import backend

    mi = backend.mitsuba()
    stream = mi.MemoryStream()
    with backend.threads(least=2):
        mi.Bitmap(LIGHT.astype(np.float32)).write(stream, mi.Bitmap.FileFormat.OpenEXR)
    stream.seek(0)
    return stream.read(stream.size())


def mesh(kind: str) -> Callable[[], bytes]:
    """A box that trimesh writes; .gltf with its buffer inside."""

    def made():
        import trimesh

        box = trimesh.creation.box((1.0, 0.8, 0.6))
        if kind != "gltf":
            data = box.export(file_type=kind)
            return data.encode() if isinstance(data, str) else data
        return trimesh.exchange.gltf.export_gltf(trimesh.Scene(box), embed_buffers=True)[
            "model.gltf"
        ]

    return made


def read_scene(path: Path) -> object:
    """A Mitsuba scene, with the picture and the mesh that it names beside it."""
    (path.parent / "brick.png").write_bytes(picture("PNG")())
    (path.parent / "mesh.ply").write_bytes(mesh("ply")())
    return worlds.from_mitsuba(path, "path", samples=1)


SEEDS: dict[str, Seed] = {
    "sky.hdr": (hdr, textures.environment),
    "sky.exr": (exr, textures.environment),
    "picture.png": (picture("PNG"), textures.photo),
    "picture.tif": (picture("TIFF"), textures.photo),
    "picture.jpg": (picture("JPEG"), textures.photo),
    **{
        f"mesh.{kind}": (mesh(kind), mesh_files.read)
        for kind in ("obj", "ply", "stl", "glb", "gltf", "dae")
    },
    "robot.urdf": (URDF.encode, robots.from_urdf),
    "scene.xml": (XML.encode, read_scene),
    "robot.yaml": (PAGE.encode, read_own),
    "poses.txt": (POSES.replace(",", " ").encode, tum.read_tum),
    "poses.csv": (POSES.encode, tum.read_tum),
}
