"""One score, as `metrics.json` and the report have it."""

import dataclasses
from typing import Any, Literal

Region = Literal["full", "changed", "static"]
_UNITS = {"psnr": "dB", "rotation_deg": "deg"}
_LOWER_IS_BETTER = ("flip", "lpips", "rotation_deg", "translation_rel")


@dataclasses.dataclass(frozen=True)
class Metric:
    """`key` psnr, ssim, …; `visit` by name, None over all; `region` of the image; `direction` of the better value."""

    key: str
    visit: str | None
    region: Region
    value: float
    unit: str
    direction: Literal["higher", "lower"]

    def to_json(self) -> dict[str, Any]:
        """A row of `metrics.json`."""
        return dataclasses.asdict(self)


def metric(key: str, value: float, *, visit: str | None, region: Region = "full") -> Metric:
    """A score with the unit and direction that its key has."""
    direction = "lower" if key in _LOWER_IS_BETTER else "higher"
    return Metric(key, visit, region, float(value), _UNITS.get(key, "1"), direction)
