"""The subcommand `pcgan data`: which public data sets there are, and their download."""

from pathlib import Path
from typing import Annotated

import typer

from replay.cli_common import errors, fail, progress

app = typer.Typer(
    name="data",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback()
def data() -> None:
    """List and download the public data sets that training, benchmarks and simulated drives use.

    **Examples**

    pcgan data list

    pcgan data get dut
    """


@app.command("list")
def list_datasets() -> None:
    """Show the data sets: size, licence, what to cite, and where this machine has them.

    **Example**

    pcgan data list
    """
    from pcgan.download import datasets, locate

    for dataset in datasets().values():
        present = locate(dataset)
        if present is None:
            where = f"not here; pcgan data get {dataset.name}"
        elif present.files == len(dataset.files):
            where = f"in {present.folder / dataset.name}"
        else:
            where = f"{present.files} of {len(dataset.files)} files in {present.folder / dataset.name}"
        size = f"{len(dataset.files)} files, {_megabytes(dataset.size_bytes)}, {dataset.clips} clips"
        typer.echo(f"{dataset.name}: {size}; {where}")
        rows = [("what", dataset.title), ("from", ", ".join(dataset.sources))]
        rows += [("licence", dataset.licence), ("cite", dataset.cite)]
        rows += [("absent", f"{absent.local}: {absent.reason}") for absent in (present or dataset).absent]
        for name, text in rows:
            typer.echo(f"  {name:7} {text}")


@app.command("get")
def get_dataset(
    name: Annotated[str, typer.Argument(metavar="NAME", help="eth_ucy (3 MB), dut (20 MB) or citr (8 MB).")],
    into: Annotated[
        Path | None, typer.Option("--into", metavar="DIR", help="The data folder. [default: ~/.cache/pcgan/data]")
    ] = None,
) -> None:
    """Download a data set, checked by its checksums; goes on where it stopped, and downloads nothing twice.

    **Examples**

    pcgan data get dut

    pcgan data get eth_ucy --into data
    """
    from pcgan.download import DownloadError, find, get, locate

    try:
        dataset = find(name)
    except ValueError as error:
        fail(str(error))
    with progress() as bar:
        task = bar.add_task(f"downloading {name}", total=None)
        try:
            fetched = get(dataset, into, progress=lambda done, total: bar.update(task, completed=done, total=total))
        except DownloadError as error:
            fail(str(error))
        except OSError as error:
            fail(f"{error.filename or into} cannot be written: {error.strerror or error}")
    came = f"{fetched.downloaded} files downloaded" if fetched.downloaded else "nothing to download"
    if fetched.downloaded:
        came += f", {_megabytes(fetched.downloaded_bytes)}"
    typer.echo(f"{name}: {came}; {fetched.clips} of {dataset.clips} clips in {fetched.folder / name}")
    for local in fetched.copied:
        typer.echo(f"  copied from another data folder: {local}")
    for absent in fetched.absent:
        typer.echo(f"  missing: {absent.local}: {absent.reason}")
    present = locate(dataset)
    if present is None or present.folder.resolve() != fetched.folder.resolve():
        reads = f"{name} is read from {present.folder}" if present else "no command reads it there"
        errors.print(f"note: {reads}; set PCGAN_DATA to {fetched.folder} to use this copy", markup=False)


def _megabytes(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:.1f} MB"
