"""Names in the text, such as `fj.simulate(…)`, lead to their place in the reference."""

import re

from docutils import nodes
from sphinx.transforms.post_transforms import SphinxPostTransform

CALL = re.compile(r"^fj\.([A-Za-z_][\w.]*)(\(.*\))?$", re.DOTALL)
CLASS = re.compile(r"^([A-Z][A-Za-z]+)(\(.*\))?$", re.DOTALL)


class CodeLinks(SphinxPostTransform):
    default_priority = 9

    def run(self, **_):
        objects = self.env.domains["py"].objects
        for literal in list(self.document.findall(nodes.literal)):
            if isinstance(literal.parent, nodes.reference) or literal.findall(nodes.reference) is None:
                continue
            text = literal.astext()
            found = CALL.match(text) or CLASS.match(text)
            target = objects.get(f"fivjax.{found.group(1)}") if found else None
            if target is None:
                continue
            to = self.app.builder.get_relative_uri(self.env.docname, target.docname) + "#" + target.node_id
            link = nodes.reference("", "", internal=True, refuri=to, reftitle=f"fivjax.{found.group(1)}")
            literal.replace_self(link)
            link += literal


def setup(app):
    app.add_post_transform(CodeLinks)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
