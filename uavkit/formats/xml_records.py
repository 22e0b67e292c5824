"""XML of unknown origin, read safely: records one after the other with bounded memory, and what is broken left out.

No document type declaration is accepted, so that no entity can be expanded; depth, size of a record and size of the
whole are bounded. Where the XML is not well formed reading goes on at the next record, and what lies between is lost;
end tags whose begin was lost with it are lost too.
"""

import re
from collections import Counter
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, field
from typing import BinaryIO
from xml.etree import ElementTree
from xml.parsers import expat

from uavkit.core.errors import InputError
from uavkit.formats.log_bytes import DamageTally

LARGEST_BYTES = 256 * 1024 * 1024
"""Of a document, unpacked."""
LARGEST_RECORD_BYTES = 64 * 1024 * 1024
MOST_ELEMENTS = 1_000_000
"""Of one record: a track has two or three for each position."""
MOST_DEPTH = 100
LONGEST_TAG = 1024 * 1024
MOST_BREAKS = 5000
"""Places where reading is taken up again; what has more of them is no XML."""
_MOST_NAMES = 1000
_FEW_RECORDS = 3
"""That tell the kind of a document whose begin is lost."""
_CHUNK = 128 * 1024


@dataclass(frozen=True, slots=True, kw_only=True)
class XmlKind:
    """What a kind of document consists of."""

    name: str
    """For messages."""
    records: frozenset[str]
    """Local names of the elements that are handed out; none of them contains another."""
    resume: bytes
    """Tags that stand open about a record, for taking up again in the middle."""


@dataclass(frozen=True, slots=True)
class XmlRecord:
    """An element, its tags without namespace, and where it stands in the document."""

    element: ElementTree.Element
    offset: int
    length: int


def is_xml_of(text: str, root: str, record: str) -> bool:
    """Tell whether the begin of a text is XML with such a root, or what is left of it, by some of its records."""
    prefix = r"<(?:[\w-]{1,40}:)?"
    if text.lstrip().startswith("<") and re.search(rf"{prefix}(?:{root}|{record})[\s>]", text):
        return True
    return len(re.findall(rf"{prefix}{record}[\s>]", text)) >= _FEW_RECORDS


def local(name: str) -> str:
    """Return a name without its namespace's prefix."""
    return name.rpartition(":")[2] if ":" in name else name


class _Window:
    """The part of a stream that may be needed again."""

    def __init__(self, stream: BinaryIO, kind: str, source: str) -> None:
        self._stream, self._kind, self._source = stream, kind, source
        self._data, self._base, self.final = b"", 0, False

    @property
    def end(self) -> int:
        """Offset after the last byte that was read."""
        return self._base + len(self._data)

    def more(self) -> None:
        """Read on; raises InputError beyond the largest document."""
        chunk = self._stream.read(_CHUNK)
        self.final = not chunk
        self._data += chunk
        if self.end > LARGEST_BYTES:
            raise InputError(
                f"{self._source}: more than {LARGEST_BYTES // 2**20} MB of {self._kind}: that is no flight"
            )
        if len(self._data) > LONGEST_TAG + _CHUNK:
            raise InputError(f"{self._source}: a tag of more than {LONGEST_TAG} bytes: that is no {self._kind}")

    def since(self, offset: int) -> bytes:
        """Return the bytes from an offset on."""
        return self._data[max(offset - self._base, 0) :]

    def drop(self, offset: int) -> None:
        """Forget what lies before an offset."""
        count = min(max(offset - self._base, 0), len(self._data))
        self._data, self._base = self._data[count:], self._base + count

    def search(self, pattern: "re.Pattern[bytes]", offset: int) -> int | None:
        """Return where a pattern begins at or after an offset, reading on for it; None where it nowhere does."""
        self.drop(offset)
        while (found := pattern.search(self._data)) is None:
            if self.final:
                return None
            self.drop(self.end - 64)
            self.more()
        return self._base + found.start()

    def fault_at(self, offset: int) -> int:
        """Return where a fault begins: expat tells an end tag that fits no begin by its name, behind the slash."""
        here = max(offset - self._base, 0)
        return offset - 2 if self._data[max(here - 2, 0) : here] == b"</" else offset

    def after_end(self, element: ElementTree.Element, offset: int) -> int:
        """Return the offset behind an element: its end is told at its end tag, of one without content behind it."""
        here = max(offset - self._base, 0)
        bare = len(element) == 0 and not element.text and self._data[max(here - 2, 0) : here] == b"/>"
        return offset if bare else self._base + self._data.index(b">", here) + 1


@dataclass(slots=True)
class _Run:
    """One run of the parser, to the end of the document or to where it is broken."""

    parser: "expat.XMLParserType"
    start: int
    """Offset in the document of the first byte of its own."""
    before: int
    """Bytes of tags put before it."""
    depth: int = 0
    elements: int = 0
    builder: "ElementTree.TreeBuilder | None" = None
    record_depth: int = 0
    begin: int = 0
    """Of the open record."""
    events: list[tuple[int, int, ElementTree.Element | None]] = field(default_factory=list)
    """Begin, where the end tag begins, and the record; None for one that was never ended."""

    @property
    def at(self) -> int:
        """Offset in the document of what is being handled."""
        return self.start + max(self.parser.CurrentByteIndex - self.before, 0)


class XmlReader:
    """Reads the records of one document."""

    def __init__(self, source: str, kind: XmlKind, tally: DamageTally) -> None:
        """Name the source for messages; the tally gets what is broken."""
        self._source, self._kind, self._tally = source, kind, tally
        names = b"|".join(sorted(name.encode() for name in kind.records))
        self._marks = re.compile(rb"<(?:[\w-]{1,40}:)?(?:" + names + rb")(?=[\s>/])")
        self.counts: Counter[str] = Counter()
        """Elements outside records by name."""
        self.fault = ""
        """The first thing that is not well formed."""

    def records(self, stream: BinaryIO) -> Iterator[XmlRecord]:
        """Yield the records of a stream at its beginning; raises InputError for what is dangerous or too large."""
        window, run = _Window(stream, self._kind.name, self._source), self._new_run(0, b"")
        for _ in range(MOST_BREAKS):
            fault = yield from self._parse(run, window)
            if not fault:
                return
            self.fault = self.fault or fault
            broken = window.fault_at(run.at) if run.builder is None else run.begin
            resumed = window.search(self._marks, max(run.at, run.start + 1))
            end = window.end if resumed is None else resumed
            self._tally.add(broken, end - broken, fault)
            if resumed is None:
                return
            run = self._new_run(resumed, self._kind.resume)
        begin = window.end
        while not window.final:
            window.drop(window.end)
            window.more()
        self._tally.add(begin, window.end - begin, "too much is broken")

    def _parse(self, run: _Run, window: _Window) -> Generator[XmlRecord, None, str]:
        """Yield records up to the end, or to where the document is broken; return how."""
        given = run.start
        while True:
            part, given = window.since(given), window.end
            try:
                run.parser.Parse(part, window.final)
                fault = ""
            except (expat.ExpatError, LookupError, ValueError) as error:  # of encodings too
                fault = f"not well-formed: {error}"
            events, run.events = run.events, []
            for begin, end_tag, element in events:
                if element is None:
                    self._tally.add(begin, end_tag - begin, "an element without an end")
                else:
                    yield XmlRecord(element, begin, window.after_end(element, end_tag) - begin)
            if fault or window.final:
                return fault
            window.drop(run.at)
            window.more()

    def _new_run(self, start: int, tags: bytes) -> _Run:
        parser = expat.ParserCreate("utf-8" if tags else None)
        run = _Run(parser, start, len(tags))
        parser.buffer_text = True
        parser.StartDoctypeDeclHandler = self._refuse
        parser.StartElementHandler = lambda name, attributes: self._started(run, name, attributes)
        parser.EndElementHandler = lambda name: self._ended(run, name)
        parser.CharacterDataHandler = lambda text: run.builder.data(text) if run.builder is not None else None
        parser.Parse(tags, False)
        return run

    def _refuse(self, *_: object) -> None:
        raise InputError(
            f"{self._source}: a document type declaration (DTD) is not accepted in {self._kind.name}: "
            "remove the DOCTYPE line"
        )

    def _started(self, run: _Run, name: str, attributes: Mapping[str, str]) -> None:
        name = local(name)
        run.depth += 1
        if run.depth > MOST_DEPTH:
            raise InputError(f"{self._source}: elements are nested more than {MOST_DEPTH} deep: that is no flight")
        if name in self._kind.records:
            if run.builder is not None:  # the end of the one before is lost
                run.events.append((run.begin, run.at, None))
            run.builder, run.begin, run.record_depth, run.elements = ElementTree.TreeBuilder(), run.at, run.depth, 0
        if run.builder is not None:
            run.builder.start(name, dict(attributes))
            run.elements += 1
            if run.elements % 100 == 0 and (run.elements > MOST_ELEMENTS or run.at - run.begin > LARGEST_RECORD_BYTES):
                raise InputError(f"{self._source}: one {self._kind.name} element is too large: that is no flight")
        elif run.parser.CurrentByteIndex >= run.before and (name in self.counts or len(self.counts) < _MOST_NAMES):
            self.counts[name] += 1

    def _ended(self, run: _Run, name: str) -> None:
        if run.builder is not None:
            run.builder.end(local(name))
            if run.depth == run.record_depth:
                run.events.append((run.begin, run.at, run.builder.close()))
                run.builder = None
        run.depth -= 1
