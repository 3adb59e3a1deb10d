// The token of the address opened the session and cannot be used again.
"use strict";

if (new URLSearchParams(location.search).has("token")) history.replaceState(null, "", location.pathname);
