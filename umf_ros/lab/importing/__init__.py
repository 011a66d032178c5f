"""Data sets and folders of files as recordings: every format is one function of `formats`."""

from umf_ros.lab.importing.formats import FORMATS
from umf_ros.lab.importing.recording import Imported, write_recording

__all__ = ["FORMATS", "Imported", "write_recording"]
