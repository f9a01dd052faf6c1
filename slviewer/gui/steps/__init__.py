"""One file for each step of the wizard, named by the step's key: each holds its panel, such as
`RigPanel`."""
