"""`umf doctor`: whether everything that the package needs works here."""

from __future__ import annotations

import typer


def command() -> None:
    """Check this machine: packages, ROS 2, DDS, weights; says what helps where something is wrong."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from umf_ros.commands import checks

    console = Console()
    findings: list[checks.Finding] = []
    with console.status("") as status:
        for name, check in checks.checks():
            status.update(f"Checking {name}")
            findings.append(check())
    table = Table("", "", "found", box=None, pad_edge=False, show_header=False)
    for finding in findings:
        table.add_row("[green]ok[/]" if finding.fine else "[bold red]problem[/]", finding.name, escape(finding.found))
    console.print(table)
    problems = [finding for finding in findings if not finding.fine]
    for problem in problems:
        console.print(f"[bold]{problem.name}:[/] {escape(problem.advice)}", highlight=False, soft_wrap=True)
    if problems:
        console.print(f"[bold red]{len(problems)} of {len(findings)} checks found a problem.")
        raise typer.Exit(1)
    console.print("[green]Everything works.")
