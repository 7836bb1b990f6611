"""An interactive bench: a filter's estimates, consistency and figures for any of its numbers.

The bench is a value, and its page computes nothing: `page` alone imports Bokeh, asks a `Bench` for a `View` or a
`Map` and draws it. Page and server exchange JSON in two properties of one Bokeh model, one question at a time; of
the moves of a slider only the latest waits. It is Bokeh without Panel, whose server would answer some requests
without the token. The package is not named `explore`: `import tuning.explore.bench` would hide the function
`tuning.explore`.
"""
