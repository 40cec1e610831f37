"""stage.toml as typed, validated models. The only place with pydantic."""

from controller.config.loader import Stage, check_driver_settings, load_stage
from controller.config.models import (
    AppearanceTable,
    CameraTable,
    DisplayTable,
    OpenConfigTable,
    ProjectorTable,
    StageTables,
)
from controller.config.writer import toml_text, write_stage

__all__ = [
    "AppearanceTable",
    "CameraTable",
    "DisplayTable",
    "OpenConfigTable",
    "ProjectorTable",
    "Stage",
    "StageTables",
    "check_driver_settings",
    "load_stage",
    "toml_text",
    "write_stage",
]
