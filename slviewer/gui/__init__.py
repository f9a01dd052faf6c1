"""The wizard's page: panels that draw a snapshot and send requests; no fact lives here, and nothing
is computed here.

`app` starts it, `shell` is the frame of the page, `steps/` holds one panel file for each step of
the wizard, `panel` what every panel is made of, `scene` the 3D view, `widgets` what several panels
draw.
"""
