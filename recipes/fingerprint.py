"""Record what environments and training compute, bit by bit, and compare with an earlier record.

python recipes/fingerprint.py --out before.json                  # every task, robot and option
python recipes/fingerprint.py --compare before.json              # exit code 1 if anything differs
python recipes/fingerprint.py --compare before.json --parts envs # without training
python recipes/fingerprint.py --compare before.json --match kuka # cases by a part of their name

A record holds for each case the first 64 bits of the SHA-256 of every tensor at every step, and the
numbers of small tensors. Records of other machines or other versions of the libraries may differ in
the last bits.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from ba_torchrl.cli.types import check_writable_file
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import write_text
from profiling.fingerprint.cases import PARTS, cases
from profiling.fingerprint.compare import compare, read_record
from profiling.fingerprint.record import run_all, versions

LINES = 12
"""Differences of a case that are printed."""


def main(arguments: list[str] | None = None) -> int:
    """Record, compare, or both; return the exit code."""
    options, old = _parse(arguments)
    parts = options.parts.split(",") if options.parts else (old["parts"] if old else PARTS)
    started = time.perf_counter()
    wanted = [case for case in cases(parts) if options.match in case.name]
    records = run_all(wanted, options.workers)
    seconds = time.perf_counter() - started
    for word in ("refused", "failed"):
        names = [name for name, record in records.items() if word in record["facts"]]
        print(f"{len(names)} cases {word}")
        if old is None:
            for name in names:
                print(f"  {name}: {records[name]['facts'][word]}")
    if options.out is not None:
        content = {"parts": list(parts), "versions": versions(), "cases": records}
        write_text(options.out, json.dumps(content, separators=(",", ":")) + "\n")
    print(f"{len(records)} cases in {seconds:.0f} s")
    if old is None:
        return 0
    if old["versions"] != versions():
        print(f"versions differ: {old['versions']} -> {versions()}")
    before = {
        name: record
        for name, record in old["cases"].items()
        if record["part"] in parts and options.match in name
    }
    found = compare(before, json.loads(json.dumps(records)))
    for name, lines in found.items():
        print("\n  ".join([name, *lines[:LINES]]))
        if len(lines) > LINES:
            print(f"  and {len(lines) - LINES} lines more")
    if found:
        print(f"different: {len(found)} of {len(records)} cases")
        return 1
    print(f"equal: {len(records)} cases")
    return 0


def _parse(arguments: list[str] | None) -> tuple[argparse.Namespace, dict[str, Any] | None]:
    """Return the checked options, and the old record if they name one."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, help="file to write the record to")
    parser.add_argument("--compare", type=Path, help="file of an earlier record")
    parser.add_argument("--parts", help=f"of {','.join(PARTS)}; all, or those of the old record")
    parser.add_argument("--match", default="", help="only cases whose name contains this")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    options = parser.parse_args(arguments)
    if options.out is None and options.compare is None:
        parser.error("give --out, --compare or both")
    if options.workers < 1:
        parser.error("--workers must be at least 1")
    if options.parts and (unknown := {*options.parts.split(",")} - {*PARTS}):
        parser.error(f"unknown: {', '.join(sorted(unknown))}")
    try:
        old = None if options.compare is None else read_record(options.compare)
        if options.out is not None:
            check_writable_file(options.out)
    except ConfigError as error:
        parser.error(str(error))
    return options, old


if __name__ == "__main__":
    sys.exit(main())
