"""The commands of the command line, one file a family: each is a public function of `slviewer.workflow`, and its words.

Nothing heavy is imported before a command needs it.
"""
