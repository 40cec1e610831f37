"""Small bundles with pictures that compress well and pictures that do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from nacl.signing import SigningKey

from controller.bundle.writer import NewAppearance, NewBundle, write_bundle

OUTPUTS = (("left", 13, 10), ("right", 8, 6))
PNG = b"\x89PNG\r\n\x1a\n" + bytes(40)


@pytest.fixture
def pictures() -> dict[str, dict[str, npt.NDArray[np.uint8]]]:
    random = np.random.default_rng(5)
    noise = {name: random.integers(0, 256, (h, w, 3), dtype=np.uint8) for name, w, h in OUTPUTS}
    ramp = {name: np.tile(np.arange(h, dtype=np.uint8)[:, None, None] * 9, (1, w, 3)) for name, w, h in OUTPUTS}
    return {"noise": noise, "ramp": ramp}


@pytest.fixture
def appearances(pictures: dict[str, dict[str, npt.NDArray[np.uint8]]]) -> list[NewAppearance]:
    return [
        NewAppearance("noise", pictures["noise"], metadata={"de": 2.5, "ist schön": True}),
        NewAppearance("ramp", pictures["ramp"], thumbnail=PNG),
    ]


@pytest.fixture
def key() -> SigningKey:
    return SigningKey(bytes(range(32)))


@pytest.fixture
def signed(tmp_path: Path, appearances: list[NewAppearance], key: SigningKey) -> Path:
    return write(tmp_path / "signed.vel", appearances, key)


@pytest.fixture
def unsigned(tmp_path: Path, appearances: list[NewAppearance]) -> Path:
    return write(tmp_path / "unsigned.vel", appearances, None)


def write(path: Path, appearances: list[NewAppearance], key: SigningKey | None) -> Path:
    write_bundle(
        path,
        NewBundle(stage="demo", calibration="run-1", created_unix_s=1_700_000_000, outputs=OUTPUTS, revision=3),
        appearances=appearances,
        key=key,
    )
    return path
