"""The subcommands of ``hil``, one module each; heavy imports only inside a command that runs."""
