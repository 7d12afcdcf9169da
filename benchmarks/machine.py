"""What a committed result says of where and when it was measured."""

import datetime
import platform
from importlib.metadata import version
from pathlib import Path


def machine(*packages: str) -> str:
    """Processor, date and versions, one line of Markdown."""
    processor = platform.processor() or "unknown processor"
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        processor = f"{names[0].partition(':')[2].strip()}, {len(names)} cores" if names else processor
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    return (
        f"{processor}; {datetime.date.today().isoformat()}; Python {platform.python_version()}, {versions}."
    )
