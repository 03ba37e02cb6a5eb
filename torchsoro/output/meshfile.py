"""A printable part as a file: binary STL with its unit in the header, or 3MF.

3MF is a ZIP of XML parts by the Open Packaging Conventions, here with one object of one mesh, in mm. Its build item
moves the part to where all coordinates are positive, where printers have their plate; the mesh stays in the coordinates
of the simulation. Trimesh writes 3MF, too, but needs lxml for it and knows no metadata.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from xml.etree import ElementTree

import numpy as np
import trimesh

CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
OWN = "urn:torchsoro:part"  # namespace of the metadata that the specification has no names for
_RELATIONS = "http://schemas.openxmlformats.org/package/2006/relationships"
_TYPES = "http://schemas.openxmlformats.org/package/2006/content-types"
_MODEL = "3D/3dmodel.model"
_STAMP = (1980, 1, 1, 0, 0, 0)  # the earliest that ZIP knows: the same part gives the same bytes


def stl(mesh: trimesh.Trimesh, note: str) -> bytes:
    """Binary STL of a mesh in mm, with a note of at most 80 ASCII characters in its header."""
    record = np.zeros(len(mesh.faces), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    record["normal"] = mesh.face_normals
    record["corners"] = mesh.triangles
    return note.encode("ascii").ljust(80) + np.uint32(len(record)).astype("<u4").tobytes() + record.tobytes()


def threemf(mesh: trimesh.Trimesh, name: str, notes: Mapping[str, str]) -> bytes:
    """3MF of a mesh in mm.

    Args:
        mesh: Closed, with outward normals.
        name: Of the object.
        notes: Metadata by name, written as ``torchsoro:name``.

    Returns:
        The bytes of the file.
    """
    head = {"unit": "millimeter", "xml:lang": "en-US", "xmlns": CORE, "xmlns:torchsoro": OWN}
    model = ElementTree.Element("model", head)
    for key, text in {"Title": name, "Application": "torchsoro"}.items():
        ElementTree.SubElement(model, "metadata", name=key).text = text
    for key, text in notes.items():
        ElementTree.SubElement(model, "metadata", {"name": f"torchsoro:{key}", "type": "xs:string"}).text = text
    resources = ElementTree.SubElement(model, "resources")
    body = ElementTree.SubElement(ElementTree.SubElement(resources, "object", id="1", type="model", name=name), "mesh")
    vertices = ElementTree.SubElement(body, "vertices")
    for x, y, z in mesh.vertices.tolist():
        # To the nanometre: far below any printer, and far apart enough that no two corners fall together.
        ElementTree.SubElement(vertices, "vertex", x=f"{x:.6f}", y=f"{y:.6f}", z=f"{z:.6f}")
    triangles = ElementTree.SubElement(body, "triangles")
    for a, b, c in mesh.faces.tolist():
        ElementTree.SubElement(triangles, "triangle", v1=str(a), v2=str(b), v3=str(c))
    shift = " ".join(f"{max(0.0, -low):.6f}" for low in mesh.bounds[0])
    build = ElementTree.SubElement(model, "build")
    ElementTree.SubElement(build, "item", objectid="1", transform=f"1 0 0 0 1 0 0 0 1 {shift}")

    relations = ElementTree.Element("Relationships", xmlns=_RELATIONS)
    kind = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
    ElementTree.SubElement(relations, "Relationship", Target=f"/{_MODEL}", Id="rel0", Type=kind)
    types = ElementTree.Element("Types", xmlns=_TYPES)
    for suffix, content in (
        ("rels", "application/vnd.openxmlformats-package.relationships+xml"),
        ("model", "application/vnd.ms-package.3dmanufacturing-3dmodel+xml"),
    ):
        ElementTree.SubElement(types, "Default", Extension=suffix, ContentType=content)

    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for path, part in (("[Content_Types].xml", types), ("_rels/.rels", relations), (_MODEL, model)):
            data = ElementTree.tostring(part, encoding="utf-8", xml_declaration=True)
            entry = zipfile.ZipInfo(path, _STAMP)
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, data)
    return packed.getvalue()
