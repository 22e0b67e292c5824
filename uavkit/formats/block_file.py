"""The block on disk: what ingest hands to process, as versioned JSON without loss."""

import json
from pathlib import Path

from uavkit.core.block import Block
from uavkit.core.errors import InputError
from uavkit.formats.atomic import write_text
from uavkit.formats.record_codec import InlineArrays, decode, encode, parse_json

FORMAT, VERSION = "uavkit block", 1


def write_block(path: Path, block: Block) -> None:
    """Write a block, whole or not at all."""
    content = {"format": FORMAT, "version": VERSION, "block": encode(block, InlineArrays())}
    write_text(path, json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_block(path: Path) -> Block:
    """Read a block; raises InputError for another format or version, unknown keys and damage."""
    try:
        content = parse_json(path, path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}): run ingest first") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"{path}: this is no block of uavkit: run ingest first")
    if content.get("version") != VERSION:
        raise InputError(
            f"{path}: the block has version {content.get('version')}, this uavkit reads {VERSION}: run ingest again"
        )
    return decode(Block, content.get("block"), InlineArrays(), f"{path}: block")
