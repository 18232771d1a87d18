"""The command line: one module or package per command, imported when the command is run.

    main.py         the list of commands; errors become one line and an exit code
    options.py      options that several commands share
    figures.py      numbers as people copy them
    connection.py   a Zenoh session with a running service
    top_frame.py    the screen of `roughmap top`
    example.toml    what `roughmap config example` prints

All other modules are commands.
"""
