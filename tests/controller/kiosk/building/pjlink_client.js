// Drives a stage with the npm package "pjlink" (node pjlink_client.js PORT PASSWORD), and prints one line of JSON for each answer.
const PJLink = require("pjlink");
const [port, password] = process.argv.slice(2);
const link = new PJLink({ host: "127.0.0.1", port: Number(port), password, timeout: 20000 });
const steps = [
  ["getPowerState"], ["getClass"], ["getName"], ["getManufacturer"], ["getInputs"], ["getLamps"], ["getErrors"],
  ["setInput", { source: "digital", channel: 2 }], ["getInput"], ["setInput", { source: "digital", channel: 7 }],
  ["setMute", { video: true, audio: true }], ["getMute"], ["setMute", { video: false, audio: false }], ["getMute"],
  ["powerOff"], ["getPowerState"],
];

function next() {
  if (!steps.length) return link.disconnect();
  const [name, ...values] = steps.shift();
  link[name](...values, (error, ...found) => {
    console.log(JSON.stringify([name, error ? error.message || error : null, ...found]));
    next();
  });
}
next();
