"use strict";
// Only GET is sent from here: reading about a route must not start a test. No validator: it is another machine's.
SwaggerUIBundle({ url: "/openapi.json", dom_id: "#api", deepLinking: true, validatorUrl: null, supportedSubmitMethods: ["get"] });
