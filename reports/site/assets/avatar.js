function avatarTab(group, g, of) { return el("p", {}, "…"); }
