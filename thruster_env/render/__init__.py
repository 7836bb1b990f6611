"""Common parts of the pictures of all plants: 640 x 400 pixels, in a window (`human`) or as arrays (`rgb_array`).

**Overlay hook.** A plant knows no filter. The env holds `render_overlay`, None or a function without arguments
that returns an overlay or None; a filter wrapper sets it: `env.unwrapped.render_overlay = ...`. A wrapper knows
its estimate only after the env's step has ended. So the env asks for it when it draws and at the start of the next
step, and hands it to the renderer's `amend`: each estimate is then drawn at the time that it is of.

Needs pygame (the extra `render`), which is imported when a renderer is made.
"""
