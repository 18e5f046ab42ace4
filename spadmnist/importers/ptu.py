"""PicoQuant's time tags."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError
from . import MOST_EVENTS, Format, Found, Said, damaged, heard, library


class Ptu(Format):
    """PicoQuant PTU, T2 mode: every detection with its channel and its time.

    Markers, and pulses of the sync input, are no detections. The records are decoded by ptufile, overflows as well.

    Source: PicoQuant, "Unified TTTR File Format".
    """

    about = "PicoQuant PTU"
    begins = (b"PQTTTR",)

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """Channels as the instrument counts them; the exposure is how long it ran, in ms, as it says itself."""
        ptufile = library(path, "ptufile", "ptu")
        try:
            with heard("ptufile"), ptufile.PtuFile(path) as file:
                if file.is_t3:
                    raise InputError(
                        f"{path}: was recorded in T3 mode, whose times count from the last laser pulse; "
                        "record in T2 mode, or export the times to CSV"
                    )
                declared, held = file.number_records, (path.stat().st_size - file.record_offset) // 4
                if declared > min(held, MOST_EVENTS):
                    raise InputError(
                        f"{path}: declares {declared:,} records, {held:,} follow and {MOST_EVENTS:,} can be read; "
                        "copy it again, or cut it into several"
                    )
                raw = file.read_records()
                records = file.decode_records(raw)
                tick, tags = float(file.global_resolution), dict(file.tags)
        except InputError:
            raise
        except Exception as error:  # a damaged header makes it raise nearly anything
            raise damaged(path, error) from None
        # marked as special, with channel 0, which the library takes for the first input (for the PicoHarp 300, which
        # has no such mark, it would be channel 8, which it has not)
        sync = raw >> 25 == 64
        counts = {"markers": int((records["marker"] > 0).sum()), "pulses of the sync input": int(sync.sum())}
        notes = tuple(f"{n:,} {what} are no detections and were left out" for what, n in counts.items() if n)
        kept = (records["channel"] >= 0) & ~sync
        facts = {"tick": tick}
        milliseconds = tags.get("TTResult_StopAfter") or tags.get("MeasDesc_AcquisitionTime")
        if isinstance(milliseconds, int) and milliseconds > 0:
            facts["exposure"] = milliseconds / 1000
        return Found(facts, records["channel"][kept].astype(np.uint8), records["time"][kept], notes=notes)
