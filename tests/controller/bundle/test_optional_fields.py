"""What a later release may add to the index: anywhere for players of today, in metadata for those of 0.2.0."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from nacl.signing import SigningKey

from controller.bundle.format import OutputLayout
from controller.bundle.index import parse_index
from controller.bundle.reader import Bundle
from controller.bundle.writer import NewAppearance, NewBundle, Packing, write_bundle
from controller.core.errors import BundleError
from tests.controller.bundle.conftest import OUTPUTS

TABLES_0_2_0 = {
    "index": {
        "stage", "calibration", "created_unix_s", "revision", "outputs", "appearances", "codec", "schedule", "live",
    },
    "outputs": {"name", "width_px", "height_px", "tile_width_px", "tile_height_px"},
    "appearances": {"name", "bands", "thumbnail", "metadata"},
}  # fmt: skip
"""The keys of each table, exactly: a player of 0.2.0 refuses any other, but in ``metadata``."""
RECORDED = (
    b'{"appearances":[{"bands":{"left":[[4096,60,"0123456789abcdef","' + b"0" * 64 + b'"]]},"metadata":'
    b'{"later":{"any":[1,null,"text"]},"mode":"bounded"},"name":"marble","thumbnail":null}],"calibration":"run-1",'
    b'"codec":"zstd","created_unix_s":1700000000,"live":null,"outputs":[{"height_px":4,"name":"left",'
    b'"tile_height_px":4,"tile_width_px":4,"width_px":4}],"revision":3,"schedule":[],"stage":"demo"}'
)
"""An index as 0.2.0 wrote it, with a field ``later`` where a later release may add one."""


def test_a_reader_skips_a_field_of_metadata_that_it_does_not_know() -> None:
    (marble,) = parse_index(RECORDED, data_end=8192).appearances
    assert marble.metadata["mode"] == "bounded"
    assert marble.metadata["later"] == {"any": [1, None, "text"]}


@pytest.mark.parametrize("table", list(TABLES_0_2_0))
def test_a_reader_skips_a_key_that_it_does_not_know_and_misses_each_that_it_does(table: str) -> None:
    index = json.loads(RECORDED)
    known = parse_index(RECORDED, data_end=8192)
    at = index if table == "index" else index[table][0]
    at["later"] = 1
    assert parse_index(json.dumps(index).encode(), data_end=8192) == known
    for key in TABLES_0_2_0[table]:
        value = at.pop(key)
        with pytest.raises(BundleError):
            parse_index(json.dumps(index).encode(), data_end=8192)
        at[key] = value


def test_images_of_an_output_that_is_not_listed_are_refused() -> None:
    index = json.loads(RECORDED)
    index["appearances"][0]["bands"]["right"] = index["appearances"][0]["bands"]["left"]
    with pytest.raises(BundleError):
        parse_index(json.dumps(index).encode(), data_end=8192)


STRIPES = {
    "index": TABLES_0_2_0["index"] - {"codec"},
    "outputs": {"name", "width_px", "height_px", "stripe_rows"},
    "appearances": {"name", "stripes", "thumbnail", "metadata"},
}
"""Those of version 2, the only one that players before 0.2.0 read; they refuse any other, too."""


@pytest.mark.parametrize("version", [2, 3])
def test_what_is_written_has_the_keys_of_the_oldest_player_that_can_show_it_and_metadata_is_signed(
    tmp_path: Path, appearances: list[NewAppearance], key: SigningKey, version: int
) -> None:
    later: dict[str, Any] = {"later": {"any": [1, None]}}
    added = [NewAppearance(one.name, one.frames, one.thumbnail, {**one.metadata, **later}) for one in appearances]
    packing = Packing(tuple(OutputLayout(name, w, h, w, h) for name, w, h in OUTPUTS), ("zstd", "lz4")[version - 2])
    file = tmp_path / "later.vel"
    write_bundle(file, NewBundle("demo", "run-1", 0, OUTPUTS), added, key=key, packing=packing)
    with Bundle.open(file, trusted=[bytes(key.verify_key)]) as bundle:
        assert bundle.version == version
        assert bundle.index.appearances[0].metadata["later"] == later["later"]
    data = file.read_bytes()
    offset, length = (int.from_bytes(data[at : at + 8], "little") for at in (16, 24))
    index, tables = json.loads(data[offset : offset + length]), TABLES_0_2_0 if version == 3 else STRIPES
    assert index.keys() == tables["index"], "older players would refuse this: CONTRIBUTING, 'A field of a bundle'"
    for table in ("outputs", "appearances"):
        assert all(row.keys() == tables[table] for row in index[table])
    at = data.index(b'"later"')
    file.write_bytes(data[:at] + b'"lates"' + data[at + 7 :])
    with pytest.raises(BundleError):
        Bundle.open(file, trusted=[bytes(key.verify_key)])
