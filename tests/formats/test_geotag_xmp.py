"""XMP packets: ours set or taken out in every form that they take, all else left byte for byte."""

import xml.etree.ElementTree as ElementTree

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.formats.geotag_stills import packet
from uavkit.core.errors import InputError
from uavkit.formats.xmp_packet import RDF, merged, padding, shortened

CAMERA, OWN = "http://pix4d.com/camera/1.0/", "urn:own/"
PREFIXES = {CAMERA: "Camera", OWN: "own"}
WANTED = {(CAMERA, "Yaw"): "12.5", (CAMERA, "Pitch"): None, (OWN, "Height"): "3"}
SENSEFLY = "http://ns.sensefly.com/Camera/1.0/"


def set_in(old: bytes | None) -> bytes:
    return merged(old, WANTED, PREFIXES, "a.jpg")


def properties(text: bytes) -> dict[str, list[str]]:
    """Return what an XML parser finds in the Descriptions, by {namespace}name."""
    found: dict[str, list[str]] = {}
    for description in ElementTree.fromstring(text.strip(b"\0")).iter(f"{{{RDF}}}Description"):
        for name, value in description.attrib.items():
            found.setdefault(name, []).append(value)
        for element in description:
            found.setdefault(element.tag, []).append(element.text or "")
    return found


@pytest.mark.parametrize(
    "body",
    [
        '<rdf:Description rdf:about="x"/>',
        "",
        "<rdf:Description xmlns:Camera='http://pix4d.com/camera/1.0/' Camera:Yaw = '1' Camera:Pitch='2'/>",
        '<rdf:Description xmlns:C="http://pix4d.com/camera/1.0"><C:Yaw>1</C:Yaw> <C:Pitch x="y">2</C:Pitch>'
        "</rdf:Description>",
        f'<rdf:Description xmlns:Camera="{SENSEFLY}" Camera:Roll="5"><o:Height xmlns:o="urn:own">9</o:Height>'
        "</rdf:Description>",
        '<rdf:Description xmlns:o="urn:own/" o:Height="7"/>'
        '<rdf:Description xmlns:o="urn:own/" o:Height="8" o:Other="9"/>',
        '<rdf:Description xmlns:o="urn:own/" o:Height="7"><q:x xmlns:q="urn:q">1</q:x></rdf:Description>',
        '<rdf:Description xmlns:q="urn:q" q:text="o:Height=&quot;7&quot; > &lt;">'
        "<q:l><rdf:Seq><rdf:li>1</rdf:li></rdf:Seq></q:l>"
        "</rdf:Description>",
    ],
)
def test_each_form_gives_one_value_and_keeps_the_rest(body: str) -> None:
    old = packet(body, padding=20)
    new = set_in(old)
    found = properties(new)
    assert found[f"{{{CAMERA}}}Yaw"] == ["12.5"]
    assert found[f"{{{OWN}}}Height"] == ["3"]
    assert (
        not {f"{{{CAMERA[:-1]}}}Yaw", f"{{{CAMERA}}}Pitch", f"{{{CAMERA[:-1]}}}Pitch", "{urn:own}Height"} & found.keys()
    )
    before = properties(old)
    for name in before.keys() - {f"{{{RDF}}}about"}:
        if not name.endswith(("Yaw", "Pitch", "Height")):
            assert found[name] == before[name]
    assert set(found.get(f"{{{RDF}}}about", [])) <= {"x", ""}
    assert set_in(new) == new
    assert new.endswith(b"\n" * 20 + b'<?xpacket end="w"?>')


def test_a_packet_without_ours_gets_one_description_and_nothing_else() -> None:
    old = packet('<rdf:Description rdf:about="DJI &amp; Co"\n a:b="c" xmlns:a="urn:a"\n/>\n ')
    new = set_in(old)
    start = next(i for i, (a, b) in enumerate(zip(old, new, strict=False)) if a != b)
    assert new[start + len(new) - len(old) :] == old[start:]
    assert properties(new)[f"{{{RDF}}}about"] == ["DJI & Co", "DJI & Co"]


def test_a_still_without_packet_gets_one() -> None:
    for nothing in (None, b"", b"\0\0"):
        new = set_in(nothing)
        assert new.startswith('<?xpacket begin="\ufeff"'.encode())
        assert properties(new)[f"{{{CAMERA}}}Yaw"] == ["12.5"]
        assert set_in(new) == new
    assert merged(None, {(OWN, "Height"): None}, PREFIXES, "a.jpg") == b""


@pytest.mark.parametrize(
    "text",
    [
        f'<rdf:RDF xmlns:rdf="{RDF}"/>',
        f'<r:RDF xmlns:r="{RDF}"></r:RDF>',
        f'<x><RDF xmlns="{RDF}"/></x>',
        f'<RDF xmlns="{RDF}"> </RDF>',
    ],
)
def test_unusual_rdf_elements_are_understood(text: str) -> None:
    new = set_in(text.encode())
    assert properties(new)[f"{{{OWN}}}Height"] == ["3"]
    assert set_in(new) == new


def test_what_ends_with_zeros_keeps_them() -> None:
    new = set_in(packet("") + b"\0\0\0")
    assert new.endswith(b"?>\0\0\0")
    assert properties(new)[f"{{{CAMERA}}}Yaw"] == ["12.5"]


def test_packets_of_makers_that_are_not_well_formed_get_ours_all_the_same() -> None:
    old = b'<x:xmpmeta><rdf:RDF><rdf:Description rdf:about="DJI" drone-dji:RtkFlag="50"></rdf:RDF></x:xmpmeta>'
    new = set_in(old)
    assert b'rdf:about="DJI"\n    xmlns:Camera' in new
    at = new.index(b"\n  <rdf:Description")
    assert new[:at] + new[at + len(new) - len(old) :] == old


@pytest.mark.parametrize(
    "text, what",
    [
        (b"no XML at all", "damaged"),
        (b"<a/>", "holds no rdf:RDF"),
        (b'<!DOCTYPE a [<!ENTITY b "cc">]><a>&b;</a>', "declares entities"),
        (
            b"<!DOCTYPE a [<!ENTITY b0 'lol'>"
            + b"".join(b"<!ENTITY b%d '%s'>" % (i, b"&b%d;" % (i - 1) * 10) for i in range(1, 12))
            + b"]><a>&b11;</a>",
            "declares entities",
        ),
    ],
)
def test_what_is_no_packet_is_refused(text: bytes, what: str) -> None:
    with pytest.raises(InputError, match=rf"a\.jpg: its XMP packet.*({what})"):
        set_in(text)


def test_padding_is_taken_from_before_the_end() -> None:
    old = packet("", padding=30)
    assert padding(old) == 29
    assert shortened(old, 29) == packet("", padding=1)
    assert (padding(packet("")), padding(b"none"), padding(b" ")) == (0, 0, 0)
    for wrong, by in ((old, 30), (b"none", 1)):
        with pytest.raises(ValueError, match="padding"):
            shortened(wrong, by)


@settings(derandomize=True, max_examples=300, deadline=None)
@given(st.binary(max_size=60), st.integers(0, 400), st.integers(0, 40))
def test_no_bytes_give_anything_but_an_input_error(noise: bytes, place: int, cut: int) -> None:
    whole = packet(
        '<rdf:Description rdf:about="x" xmlns:C="http://pix4d.com/camera/1.0" C:Yaw="1"><C:Pitch/></rdf:Description>'
    )
    try:
        new = set_in(whole[:place] + noise + whole[place + cut :])
    except InputError:
        return
    assert b'Camera:Yaw="12.5"' in new
