"""Write the frames of a board in C, for the firmware core in firmware/.

The board's DBC file and the meaning of its signals are those of the stage file (can.dbc, can.wire), for the kind of bus
that can.fd says; without a DBC file they are the package's own. The core is then built with them by
`make -C firmware GENERATED=DIR BUILD=DIR/build`."""

import argparse
from pathlib import Path

from straightcomp_ros.cli.options import add_force, named_files
from straightcomp_ros.cli.output import CommandFailed, console, print_json
from straightcomp_ros.cli.parameter_options import add_setting_option, add_stage_argument, stage_values
from straightcomp_ros.hardware.can.dbc_file import DbcError
from straightcomp_ros.hardware.can.frames_in_c import frames_in_c
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.parameters.output_folder import making
from straightcomp_ros.parameters.whole_file import write_whole

SUMMARY = "write the frames of a board in C, for its firmware"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_stage_argument(parser)
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, required=True, help="folder for the C files")
    add_setting_option(parser)
    add_force(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> None:
    wire = node_parameters("driver", stage_values(options)).can.make_wire()
    try:
        texts = frames_in_c([wire])
    except DbcError as error:
        raise CommandFailed(f"{wire.dbc.file}: {error}", exit_code=2) from error
    folder: Path = options.output
    try:
        with making(folder, texts, reads=named_files(options, "--output"), force=options.force, anew=False):
            for name, text in texts.items():
                write_whole(folder / name, text)
    except OSError as error:
        raise CommandFailed(f"'{error.filename or folder}': {error.strerror}", exit_code=2) from error
    build = f"make -C firmware GENERATED={folder.absolute()} BUILD={folder.absolute() / 'build'}"
    if options.json:
        print_json({"source": wire.source(), "files": [str(folder / name) for name in texts], "build": build})
        return
    console.print(f"{', '.join(texts)} in {folder}: the frames of {wire.source()}", soft_wrap=True, highlight=False)
    console.print(f"in the source of straightcomp_ros: {build}", soft_wrap=True, highlight=False)
