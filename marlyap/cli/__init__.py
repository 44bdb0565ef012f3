"""The command line."""

from marlyap.cli.entry import (
    ENDING as ENDING,
    EXAMPLES as EXAMPLES,
    command as command,
    exit_interrupted as exit_interrupted,
    main as main,
    on_interrupt_exit as on_interrupt_exit,
    parse as parse,
    parser as parser,
    program as program,
)
