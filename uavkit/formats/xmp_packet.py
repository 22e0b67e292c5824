"""XMP packets: properties set or taken out, every other byte of the packet left as it was.

ISO 16684-1: properties stand in rdf:Description elements, as attributes or as elements; several Descriptions of the
same rdf:about are one. Ours go into one of their own, so that nothing of others is parsed and written again.
"""

import re
from collections.abc import Mapping
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from uavkit.core.errors import InputError

RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
Property = tuple[str, str]
"""Namespace and name. Namespaces are compared without a slash at their end: makers write them with and without."""

_WRAPPER = (
    '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
    f' <rdf:RDF xmlns:rdf="{RDF}">\n </rdf:RDF>\n</x:xmpmeta>\n<?xpacket end="w"?>'
)
_TAG = re.compile(rb"<(?:[^<>\"']|\"[^\"]*\"|'[^']*')*>")
_PADDING = re.compile(rb"([ \t\r\n]*)<\?xpacket end=")
_ABOUT = re.compile(rb"<rdf:Description\s[^>]*?rdf:about\s*=\s*[\"']([^\"'<>&]*)[\"']")


def merged(
    packet: bytes | None, properties: Mapping[Property, str | None], prefixes: Mapping[str, str], name: str
) -> bytes:
    """Return the packet with the properties set, or taken out where their value is None; without a packet a new one.

    ``prefixes`` gives the prefix of each namespace that is set. Raises InputError where the packet is no XMP. In one
    that is not well-formed (some makers' are not) ours are set before its end and nothing is taken out.
    """
    values = {key: value for key, value in properties.items() if value is not None}
    if packet is None or not packet.strip(b"\0 \t\r\n"):
        return merged(_WRAPPER.encode(), values, prefixes, name) if values else packet or b""
    body = packet.rstrip(b"\0")
    try:
        scan = _Scan(body, {_key(*each) for each in properties})
    except expat.ExpatError as error:
        return _set_blindly(packet, values, prefixes, f"{name}: its XMP packet is damaged ({error})")
    except _NoPacketError as why:
        raise InputError(f"{name}: its XMP packet {why}: it is no XMP; remove it from the still first") from why
    edits = [*((start, end, b"") for start, end in scan.cuts)]
    if values:
        edits.append(scan.insertion(description(values, prefixes, scan.rdf_prefix, scan.about)))
    for start, end, new in sorted(edits, reverse=True):
        body = body[:start] + new + body[end:]
    return body + packet[len(packet.rstrip(b"\0")) :]


def description(values: Mapping[Property, str], prefixes: Mapping[str, str], rdf: str, about: str) -> bytes:
    """Return an rdf:Description with the properties as attributes."""
    used = sorted({space for space, _ in values})
    declared = "" if rdf else f" xmlns:rdf={quoteattr(RDF)}"
    rdf = rdf or "rdf"
    lines = [f"<{rdf}:Description{declared} {rdf}:about={quoteattr(about)}"]
    lines += [f"    xmlns:{prefixes[space]}={quoteattr(space)}" for space in used]
    lines += [f"   {prefixes[space]}:{name}={quoteattr(value)}" for (space, name), value in values.items()]
    return ("\n  " + "\n".join(lines) + "/>").encode()


def _set_blindly(packet: bytes, values: Mapping[Property, str], prefixes: Mapping[str, str], what: str) -> bytes:
    place = packet.rfind(b"</rdf:RDF>")
    if place < 0:
        raise InputError(f"{what}, and its end is not found: remove it from the still first")
    about = _ABOUT.search(packet)
    text = about[1].decode("utf-8", errors="replace") if about else ""
    return packet[:place] + (description(values, prefixes, "rdf", text) if values else b"") + packet[place:]


def padding(packet: bytes) -> int:
    """Return how many bytes ``shortened`` can take out: white space before the packet's end, but for one."""
    found = _last_padding(packet)
    return max(len(found[1]) - 1, 0) if found else 0


def shortened(packet: bytes, by: int) -> bytes:
    """Return the packet with so many bytes less of padding; raises ValueError where it has not as many."""
    found = _last_padding(packet)
    if found is None or by >= len(found[1]):
        raise ValueError(f"{by} bytes of padding asked for, {padding(packet)} are there")
    return packet[: found.start()] + packet[found.start() + by :]


def _last_padding(packet: bytes) -> re.Match[bytes] | None:
    place = packet.rfind(b"<?xpacket end=")
    start = len(packet[: max(place, 0)].rstrip(b" \t\r\n"))
    return _PADDING.match(packet, start) if place >= 0 else None


def _key(namespace: str, name: str) -> Property:
    return namespace.rstrip("/"), name


class _NoPacketError(Exception):
    """Well-formed XML that is no XMP; the text says why."""


class _Scan:
    """Where a packet's Descriptions hold certain properties, and where its RDF ends, in bytes."""

    def __init__(self, body: bytes, wanted: set[Property]) -> None:
        self.rdf_end = -1
        """Where its end tag stands, or the whole element where it is empty and has none."""
        self.rdf_prefix, self.about = "rdf", ""
        self.cuts: list[tuple[int, int]] = []
        self._body, self._wanted = body, wanted
        self._path: list[Property] = []
        self._starts: list[tuple[int, int]] = []
        """Of each element of the path: where its start tag begins and ends."""
        self._element_from: int | None = None
        self._description_from: int | None = None
        self._described = False
        parser = expat.ParserCreate(namespace_separator=" ")
        parser.namespace_prefixes = True
        parser.StartElementHandler, parser.EndElementHandler = self._start, self._end
        parser.StartDoctypeDeclHandler = self._doctype
        self._parser = parser
        parser.Parse(body, True)
        if self.rdf_end < 0:
            raise _NoPacketError("holds no rdf:RDF")

    def insertion(self, text: bytes) -> tuple[int, int, bytes]:
        """Return the edit that sets a Description at the end of the RDF element."""
        at = self.rdf_end
        if self._body.startswith(b"</", at):
            before = len(self._body[:at].rstrip(b" \t\r\n"))
            return before, before, text
        end = self._tag_end(at)
        close = f"</{self.rdf_prefix}:RDF>" if self.rdf_prefix else "</RDF>"
        return end - 2, end, b">" + text + close.encode()

    def _tag_end(self, start: int) -> int:
        tag = _TAG.match(self._body, start)
        return tag.end() if tag is not None else start

    def _doctype(self, *_: object) -> None:
        raise _NoPacketError("declares entities")  # of which a few lines can fill the memory

    def _depth(self) -> int:
        """Return the element's depth below rdf:RDF, or -1 outside it."""
        rdf = _key(RDF, "RDF")
        return len(self._path) - 1 - self._path.index(rdf) if rdf in self._path else -1

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        at = self._parser.CurrentByteIndex
        self._path.append(_split(name)[0])
        self._starts.append((at, self._tag_end(at)))
        depth = self._depth()
        if depth == 1 and self._path[-1] == _key(RDF, "Description"):
            self._look_at(attributes, at)
        elif depth == 2:
            if self._path[-1] in self._wanted:
                self._element_from = at
            else:
                self._description_from = None  # it holds something of others and stays

    def _look_at(self, attributes: dict[str, str], at: int) -> None:
        keys = {_split(name)[0]: value for name, value in attributes.items()}
        if not self._described:
            self.about = keys.get(_key(RDF, "about"), keys.get(("", "about"), ""))
        self._described = True
        ours = keys.keys() & self._wanted
        if ours and keys.keys() <= ours | {_key(RDF, "about")}:
            self._description_from = at
        for name in attributes:
            key, prefix = _split(name)
            if key in ours:
                self._cut_attribute(at, f"{prefix}:{key[1]}")

    def _cut_attribute(self, at: int, name: str) -> None:
        pattern = re.compile(rb"\s+" + re.escape(name.encode()) + rb"\s*=\s*(?:\"[^\"]*\"|'[^']*')")
        found = pattern.search(self._body, at, self._tag_end(at))
        if found is not None:
            self.cuts.append(found.span())

    def _end(self, name: str) -> None:
        (start, start_end), depth = self._starts.pop(), self._depth()
        empty = self._body.endswith(b"/>", start, start_end)
        # where an element without end tag ends expat does not tell the same in all versions
        at = start if empty else self._parser.CurrentByteIndex
        if depth == 2 and self._element_from is not None:
            self._cut(self._element_from, self._tag_end(at))
            self._element_from = None
        if depth == 1 and self._description_from is not None:
            self._cut(self._description_from, self._tag_end(at))
            self._description_from = None
        if depth == 0 and self.rdf_end < 0:
            self.rdf_prefix, self.rdf_end = _split(name)[1], at
        self._path.pop()

    def _cut(self, start: int, end: int) -> None:
        """Cut an element with the white space before it, and forget the cuts within."""
        start = len(self._body[:start].rstrip(b" \t\r\n"))
        self.cuts = [cut for cut in self.cuts if not (start <= cut[0] and cut[1] <= end)] + [(start, end)]


def _split(name: str) -> tuple[Property, str]:
    """Return namespace and name, and the prefix, of expat's triple."""
    parts = name.split(" ")
    if len(parts) == 1:
        return ("", parts[0]), ""
    return _key(parts[0], parts[1]), parts[2] if len(parts) > 2 else ""
