"""The commands of the command line, one file a family: each is a function of `slviewer.pipeline`,
`preflight` or `validation`, and its messages.

Nothing heavy is imported before a command needs it.
"""
